// The jobs that this tab has sent: their ids are kept here, the rest is asked of the server.

import { call, json, pause } from "./api.js";
import { element, offerDownload } from "./report.js";
import { keep, kept } from "./session.js";
import * as text from "./text.js";

const KEY = "straightpcf.jobs";
const MOST = 50;
const ASKED = 200;
const FORGET_MS = [0, 1_000, 5_000]; // the server reads a file to its end before there is a job to delete
const SAID = {
  queued: "waiting", starting: "starting", processing: "working", succeeded: "done", failed: "failed", canceled: "canceled",
  expired: "expired: its files are gone",
};

let looks = 0; // at the list: an answer that comes behind that to a later one is old

export function rememberJob(id) {
  keep(KEY, JSON.stringify([id, ...known().filter((other) => other !== id)].slice(0, MOST)));
}

// An id for a job to be made. randomUUID would be one, but is for HTTPS and localhost alone.
export function newJobId() {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

// Delete a job of which nobody heard whether it was made.
export async function forgetJob(id) {
  for (const wait of FORGET_MS) {
    await pause(wait);
    try {
      await call(`jobs/${encodeURIComponent(id)}`, { method: "DELETE", keepalive: true });
      return;
    } catch (error) {
      if (error.status && error.status !== 404) return;
    }
  }
}

// Fill `list`, and show `section` if there is anything in it.
export async function showJobs({ section, list, ...hooks }) {
  const mine = ++looks;
  if (known().length === 0) {
    section.hidden = true;
    return;
  }
  const ours = await found();
  if (mine !== looks) return;
  section.hidden = ours.length === 0;
  const again = () => showJobs({ section, list, ...hooks });
  const rows = ours.map((job, at) => row(job, { name: told(ours, at), again, ...hooks }));
  const focused = list.contains(document.activeElement) ? document.activeElement : null;
  const place = [...list.children].findIndex((item) => item.contains(focused));
  list.replaceChildren(...rows);
  if (focused) focusAgain(list, focused.getAttribute("aria-label"), place);
}

// Return this tab's jobs that there still are, the newest first, also those that many others came after.
async function found() {
  const { jobs, next_cursor: more } = await json(`jobs?limit=${ASKED}`);
  const listed = new Map(jobs.map((job) => [job.id, job]));
  const others = known().filter((id) => more && !listed.has(id));
  const older = await Promise.allSettled(others.map((id) => json(`jobs/${encodeURIComponent(id)}`)));
  for (const { status, value, reason } of older) {
    if (status === "fulfilled") listed.set(value.id, value);
    else if (reason.status !== 404) throw reason;
  }
  return known().flatMap((id) => listed.get(id) ?? []);
}

// Where the focus was in a list that is new: on the same button, else in the same place.
function focusAgain(list, label, place) {
  const same = [...list.querySelectorAll("[aria-label]")].find((button) => button.getAttribute("aria-label") === label);
  const row = list.children[place] ?? list.lastElementChild;
  (same ?? row?.querySelector("button") ?? document.getElementById("file")).focus();
}

// What a job is called beside others: of those with one name, the oldest first, the second is "name (2)".
function told(jobs, at) {
  const name = nameOf(jobs[at]);
  const number = jobs.slice(at).filter((job) => nameOf(job) === name).length;
  return number === 1 ? name : `${name} (${number})`;
}

function nameOf(job) {
  return job.name ?? job.id;
}

function row(job, { name, again, onShow, onDeleted, onProblem }) {
  const item = document.createElement("li");
  const size = job.points === null ? text.bytes(job.bytes) : text.plural(job.points, "point");
  const actions = element("div", "", { class: "actions" });
  const add = (label, attributes, act) => {
    const button = element("button", label, { type: "button", class: "plain", "aria-label": `${label} ${name}`, ...attributes });
    button.addEventListener("click", () => Promise.resolve(act()).catch(onProblem));
    actions.append(button);
  };
  if (job.state !== "expired") add("Show", {}, () => onShow(job));
  if (job.state === "succeeded") {
    const link = element("a", "Download", { class: "plain button", "aria-label": `Download the result of ${name}` });
    offerDownload(link, job, onProblem);
    actions.append(link);
  }
  add("Delete", {}, async () => {
    try {
      await call(`jobs/${encodeURIComponent(job.id)}`, { method: "DELETE" });
    } catch (problem) {
      if (problem.status !== 404) throw problem; // else it is gone, as is wanted
    }
    onDeleted(job);
    await again();
  });
  item.append(element("span", name, { class: "name" }), element("span", `${SAID[job.state] ?? job.state} · ${size}`, { class: "quiet" }), actions);
  return item;
}

function known() {
  return JSON.parse(kept(KEY) ?? "[]");
}
