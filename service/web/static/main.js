// The page: a file and options go out as a job; its words, points and result come back.

import { Problem, apiKey, call, json, keepApiKey, upload } from "./api.js";
import { Cloud } from "./cloud.js";
import { followJob, thinning } from "./follow.js";
import { Form } from "./form.js";
import { forgetJob, newJobId, rememberJob, showJobs } from "./jobs.js";
import { canRead, readFile } from "./read/reader.js";
import { READABLE, suffixOf } from "./read/index.js";
import { offerDownload, showReport } from "./report.js";
import { Stage } from "./stage.js";
import * as text from "./text.js";

const BETWEEN = ["connection_failed", "error"]; // codes of what is not the server's own answer: it may have the file

const parts = Object.fromEntries([...document.querySelectorAll("[id]")].map((part) => [part.id, part]));
const stage = new Stage(parts);
const form = new Form(parts, chosen, (detail) => showProblem(new Problem({ code: "", detail })));
const files = new Map(); // the file of each job that was sent since the page was loaded
let latest = { file: null, reading: null }; // the file that was read last, and the promise of what is in it
let run = null; // {id, abort} while a job is sent or followed; id is null until the server has the file
let shown = null; // the id of the job whose result is shown
let isAway = false; // the problem that is shown is a server that does not answer

parts.form.addEventListener("submit", (event) => {
  event.preventDefault();
  if (!run) send().catch(showProblem);
});
parts.cancel.addEventListener("click", () => cancel().catch(showProblem));
parts.key.addEventListener("change", takeKey);
parts.key.addEventListener("keydown", (event) => {
  if (event.key !== "Enter") return;
  event.preventDefault(); // it would send the form
  takeKey();
});
parts["jobs-refresh"].addEventListener("click", listJobs);
parts.key.value = apiKey(); // a reload keeps it
parts["key-row"].hidden = !apiKey();
begin();

function takeKey() {
  parts.error.hidden = true; // it was of the key before
  keepApiKey(parts.key.value.trim());
  begin();
}

function begin() {
  json("v1/info").then((info) => form.showInfo(info)).catch(showProblem);
  listJobs();
}

function chosen(file) {
  parts.error.hidden = true;
  if (run) return; // what is on the stage is the running job's
  latest = { file: null, reading: null }; // the same file may have changed
  readingOf(file).then((before) => {
    if (form.file === file && !run) showBefore(file, before);
  });
}

function readingOf(file) {
  if (latest.file !== file) latest = { file, reading: read(file) };
  return latest.reading;
}

// Return {count, stride, xyz, fault}, or {fault} where the page cannot read the file.
async function read(file) {
  if (!canRead(file.name, file.size)) {
    const suffix = suffixOf(file.name);
    const size = READABLE.includes(suffix) ? ` of ${text.bytes(file.size)}` : "";
    return { fault: `This page does not read ${suffix || "such"} files${size}: only the result will be shown.` };
  }
  stage.note("Reading…");
  try {
    return await readFile(file, file.name);
  } catch (error) {
    return { fault: `This page could not read ${file.name} (${error.message}): only the result will be shown.` };
  }
}

function showBefore(file, before) {
  hideResult();
  parts.progress.hidden = true;
  if (!before.xyz || before.count === 0) {
    stage.show(null, before.fault ?? `${file.name} has no points.`);
    return;
  }
  const cloud = new Cloud({ count: before.count, stride: before.stride, before: before.xyz });
  stage.show(cloud, `${file.name}: ${text.plural(cloud.count, "point")}. ${thinning(cloud)}`);
}

async function send() {
  parts.error.hidden = true;
  keepApiKey(parts.key.value.trim());
  const fault = form.fault();
  if (fault) {
    showProblem(new Problem({ code: "", detail: fault.line }));
    fault.part.focus();
    return;
  }
  const { file } = form;
  const abort = new AbortController();
  const mine = (run = { id: null, abort });
  const id = newJobId(); // so that the job can be deleted even if the answer never comes
  busy(true);
  say("Sending", 0);
  try {
    const onProgress = (share) => say(`Sending, ${Math.round(100 * share)} %`, share);
    await upload(`jobs/${id}?${form.query()}`, file, { onProgress, signal: abort.signal });
    mine.id = id;
    files.set(id, file);
    rememberJob(id);
    listJobs();
    await follow(id, await readingOf(file), abort.signal);
  } catch (error) {
    if (run === mine) parts.progress.hidden = true;
    if (mine.id === null && (abort.signal.aborted || BETWEEN.includes(error.code))) forgetJob(id);
    if (!abort.signal.aborted) throw error;
    if (run === mine && mine.id === null) speak("Canceled");
  } finally {
    done(mine);
  }
}

async function follow(id, before, signal) {
  signal.throwIfAborted(); // while its file was read: what is shown by now is another's
  hideResult();
  let note = before?.xyz ? "" : before?.fault ?? "";
  if (!before?.xyz) stage.show(null, note);
  const hooks = {
    onEvent: showEvent,
    onCloud: (cloud, line) => stage.show(cloud, (note = line)),
    onNote: (line) => stage.note((note = line)),
    onPoints: (how) => stage.refresh(how),
  };
  const job = await followJob(id, { before: before?.xyz ? before : null, hooks, signal });
  if (job.state === "succeeded") {
    parts.progress.hidden = true;
    speak("Done");
    stage.note(note); // what was said on the way is over, or among the report's warnings
    showReport(job, parts);
    offerDownload(parts.download, job, showProblem);
    parts.report.hidden = false;
    shown = id;
    if (isWaiting()) parts["report-title"].focus({ preventScroll: true });
  } else {
    parts.progress.hidden = true;
    if (job.state === "canceled") {
      speak("Canceled"); // wanted, and so no fault
      stage.note("The job was canceled.");
    } else if (job.error) {
      showProblem(new Problem({ ...job.error, requestId: "" }));
    } else {
      stage.note(`The job is ${job.state}.`);
    }
  }
}

// Whoever is at other controls meanwhile is not taken away from them.
function isWaiting() {
  const { activeElement } = document;
  return activeElement === document.body || activeElement.closest(".actions") !== null;
}

function hideResult() {
  parts.report.hidden = true;
  shown = null;
}

// Follow a job of the list; one that runs here is left to run on the server, but a file that is still sent is not lost.
async function showJob(job) {
  if (run && run.id === null) {
    showProblem(new Problem({ code: "", detail: "A file is being sent. Wait until it is there, or cancel it." }));
    return;
  }
  run?.abort.abort();
  parts.error.hidden = true;
  const abort = new AbortController();
  const mine = (run = { id: job.id, abort });
  busy(true);
  try {
    const file = files.get(job.id);
    await follow(job.id, file ? await readingOf(file) : { fault: "" }, abort.signal);
  } catch (error) {
    if (run === mine) parts.progress.hidden = true;
    if (!abort.signal.aborted) throw error;
  } finally {
    done(mine);
  }
}

function done(mine) {
  if (run === mine) {
    run = null;
    busy(false);
  }
  listJobs();
}

async function cancel() {
  if (!run) return;
  if (run.id === null) run.abort.abort();
  else await call(`jobs/${encodeURIComponent(run.id)}/cancel`, { method: "POST" });
}

// A job of the list was deleted here: nothing of it is left to follow or to download.
function deleted(job) {
  files.delete(job.id);
  const isFollowed = run?.id === job.id;
  if (!isFollowed && shown !== job.id) return;
  if (isFollowed) run.abort.abort();
  hideResult();
  speak("Deleted");
  stage.note("The job was deleted.");
}

function listJobs() {
  const hooks = { onShow: showJob, onDeleted: deleted, onProblem: showProblem };
  showJobs({ section: parts.jobs, list: parts["jobs-list"], ...hooks }).catch(showProblem);
}

function showEvent(kind, data) {
  if (isAway && kind !== "reconnecting") parts.error.hidden = true; // it is back
  if (kind === "queued") {
    const line = data.position ? `Waiting: ${text.plural(data.position, "job")} before this one` : "Waiting";
    say(line, null, { aloud: true });
  } else if (kind === "start") {
    say(`Started${data.device ? ` on ${data.device}` : ""}`, 0, { aloud: true });
  } else if (kind === "progress") {
    say(`Pass ${data.iteration}, ${Math.round(100 * data.progress)} %`, data.progress, { aloud: isQuarter(data.progress) });
  } else if (kind === "log") {
    stage.note(data.message);
  } else if (kind === "reconnecting") {
    say("The connection is lost; trying again", null, { aloud: true });
  }
}

let quarter = 0;

// True where another quarter of the way is done: often enough to be read out.
function isQuarter(progress) {
  const now = Math.floor(4 * progress);
  const isNew = now !== quarter;
  quarter = now;
  return isNew;
}

// share: 0..1, or null while nobody knows.
function say(line, share, { aloud = false } = {}) {
  parts.progress.hidden = false;
  parts.status.textContent = line;
  if (share === null) parts.bar.removeAttribute("value");
  else parts.bar.value = share;
  if (aloud) speak(line);
}

function speak(line) {
  parts.spoken.textContent = line;
}

function busy(isBusy) {
  parts.submit.setAttribute("aria-disabled", isBusy); // `disabled` would lose the focus, as would what is hidden
  if (!isBusy && document.activeElement === parts.cancel) parts.submit.focus();
  parts.cancel.hidden = !isBusy;
}

function showProblem(problem) {
  if (!(problem instanceof Problem)) console.error(problem);
  if (problem.status === 401) {
    parts["key-row"].hidden = false;
    parts.key.focus();
  }
  isAway = problem.code === "connection_failed";
  const lines = [document.createElement("strong"), document.createElement("p")];
  lines[0].textContent = problem.detail ?? "The page met an error of its own.";
  const marks = [problem.code, problem.requestId && `request ${problem.requestId}`, problem.retryable && "worth another try"];
  lines[1].textContent = marks.filter(Boolean).join(" · ");
  lines[1].className = "quiet";
  parts.error.replaceChildren(...lines);
  parts.error.hidden = false;
}
