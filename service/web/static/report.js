// What the denoising did, in figures.

import { apiKey, call, url } from "./api.js";
import * as text from "./text.js";

const RELEASE_MS = 60_000;

// Fill a <dl> and a <ul> from a succeeded job.
export function showReport(job, { figures, warnings }) {
  const { report } = job;
  const moved = report.displacement ?? {};
  const rows = [
    ["Points", text.count(report.points)],
    ["Passes", text.count(report.iterations)],
    ["Noise before", text.length(report.noise_before)],
    ["Noise after", text.length(report.noise_after)],
    ["Moved, median", text.length(moved.p50)],
    ["90 % moved at most", text.length(moved.p90)],
    ["99 % moved at most", text.length(moved.p99)],
    ["Farthest move", text.length(moved.max)],
    ["Untouched points", text.count(report.untouched)],
    ["Time", `${text.seconds(report.seconds)}${report.device ? ` on ${report.device}` : ""}`],
  ];
  figures.replaceChildren(...rows.flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
  warnings.replaceChildren(element("li", "Lengths are in the file’s own unit."), ...(report.warnings ?? []).map((line) => element("li", line)));
}

// Make `link` download a job's result: straight to the disk, or through memory where a key must be sent.
export function offerDownload(link, job, onProblem) {
  const path = `jobs/${encodeURIComponent(job.id)}/result`;
  link.href = url(path);
  link.download = job.result.filename;
  link.title = `${job.result.filename}, ${text.bytes(job.result.bytes)}`;
  link.onclick = async (event) => {
    if (!apiKey()) return;
    event.preventDefault();
    try {
      const blob = await (await call(path)).blob();
      const saved = document.createElement("a");
      saved.href = URL.createObjectURL(blob);
      saved.download = job.result.filename;
      saved.click();
      setTimeout(() => URL.revokeObjectURL(saved.href), RELEASE_MS);
    } catch (problem) {
      onProblem(problem);
    }
  };
}

export function element(name, content, attributes = {}) {
  const made = document.createElement(name);
  made.textContent = content;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}
