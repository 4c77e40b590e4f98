// The jobs that this tab has sent: their ids are kept here, the rest is asked of the server.

import { call, json } from "./api.js";
import { element, offerDownload } from "./report.js";
import * as text from "./text.js";

const KEY = "straightpcf.jobs";
const MOST = 50;
const ASKED = 200;
const SAID = {
  queued: "waiting", starting: "starting", processing: "working", succeeded: "done", failed: "failed", canceled: "canceled",
  expired: "expired: its files are gone",
};

export function rememberJob(id) {
  sessionStorage.setItem(KEY, JSON.stringify([id, ...known().filter((other) => other !== id)].slice(0, MOST)));
}

// Fill `list`, and show `section` if there is anything in it.
export async function showJobs({ section, list, onShow, onProblem }) {
  if (known().length === 0) {
    section.hidden = true;
    return;
  }
  const { jobs } = await json(`jobs?limit=${ASKED}`);
  const ours = jobs.filter((job) => known().includes(job.id));
  section.hidden = ours.length === 0;
  const again = () => showJobs({ section, list, onShow, onProblem });
  list.replaceChildren(...ours.map((job) => row(job, { again, onShow, onProblem })));
}

function row(job, { again, onShow, onProblem }) {
  const item = document.createElement("li");
  const name = job.name ?? job.id;
  const size = job.points === null ? text.bytes(job.bytes) : text.plural(job.points, "point");
  const actions = element("div", "", { class: "actions" });
  const add = (label, attributes, act) => {
    const button = element("button", label, { type: "button", class: "plain", "aria-label": `${label} ${name}`, ...attributes });
    button.addEventListener("click", () => Promise.resolve(act()).catch(onProblem));
    actions.append(button);
  };
  if (job.state !== "expired") add("Show", {}, () => onShow(job));
  if (job.state === "succeeded") {
    const link = element("a", "Download", { class: "plain button", "aria-label": `Download ${job.result.filename}` });
    offerDownload(link, job, onProblem);
    actions.append(link);
  }
  add("Delete", {}, async () => {
    await call(`jobs/${encodeURIComponent(job.id)}`, { method: "DELETE" });
    await again();
  });
  item.append(element("span", name, { class: "name" }), element("span", `${SAID[job.state] ?? job.state} · ${size}`, { class: "quiet" }), actions);
  return item;
}

function known() {
  return JSON.parse(sessionStorage.getItem(KEY) ?? "[]");
}
