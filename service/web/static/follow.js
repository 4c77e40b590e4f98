// Follow one job from its id to its end: events for the words, patches for the picture.

import { call, pause } from "./api.js";
import { Cloud } from "./cloud.js";
import { watchJob } from "./events.js";
import { watchPatches } from "./patches.js";
import { canRead, readFile } from "./read/reader.js";

const REFRESH_MS = 250;
const REFRESH_MS_PER_MILLION = 750;
const SILENCE_MS = 10_000; // of the patches of a job that is done: a proxy may keep them

// before: {count, stride, xyz} of the reader, or null. hooks: onEvent(kind, data), onCloud(cloud, note), onPoints({isWhole}).
// Resolve to the finished job.
export async function followJob(id, { before, hooks, signal }) {
  let isOver = false;
  let cloud = before ? new Cloud({ count: before.count, stride: before.stride, before: before.xyz }) : null;
  if (cloud) hooks.onCloud(cloud, thinning(cloud));
  let timer = null;
  const soon = () => {
    timer ??= setTimeout(() => {
      timer = null;
      hooks.onPoints({ isWhole: false });
    }, REFRESH_MS + (REFRESH_MS_PER_MILLION * cloud.shown) / 1e6);
  };

  const onHeader = (points) => {
    if (cloud?.count === points) return;
    const note = cloud ? "The page read another number of points than the server, so only the result is shown." : "";
    cloud = new Cloud({ count: points });
    hooks.onCloud(cloud, note || `Only the result is shown, coloured by height. ${thinning(cloud)}`);
  };
  let frames = 0;
  const onFrame = (frame) => {
    frames++;
    cloud.put(frame.rows, frame.xyz);
    soon();
  };

  const ended = new AbortController();
  const either = AbortSignal.any([signal, ended.signal]);
  // Not while the job waits: over HTTP/1.1 a browser has six connections to a server, for all of its tabs together.
  let patches = null;
  const beginPatches = () => {
    patches ??= watchPatches(id, { onHeader, onFrame, isOver: () => isOver }, either).catch(() => false);
    return patches;
  };
  const onEvent = (kind, data) => {
    if (kind === "start") beginPatches();
    hooks.onEvent(kind, data);
  };
  const silence = async () => {
    for (let before = -1; before !== frames; ) {
      before = frames;
      await pause(SILENCE_MS, either);
    }
    return false;
  };
  try {
    const job = await watchJob(id, onEvent, signal);
    isOver = true;
    if (job.state !== "succeeded") return job;
    const isWhole = await Promise.race([beginPatches(), silence()]);
    ended.abort(); // what comes late would be put over the result
    if (!isWhole && !signal.aborted) cloud = (await fromResult(job, cloud, hooks, signal)) ?? cloud;
    clearTimeout(timer);
    if (cloud && !signal.aborted) hooks.onPoints({ isWhole: true });
    return job;
  } finally {
    ended.abort();
    clearTimeout(timer);
  }
}

// The patches are gone, broke off or do not come: take the positions from the result's file, where the page can read it.
async function fromResult(job, cloud, hooks, signal) {
  const { filename, bytes } = job.result;
  if (!canRead(filename, bytes)) {
    hooks.onNote(`This page cannot read ${filename}; download it to see it.`);
    return null;
  }
  let read;
  try {
    const file = await (await call(`jobs/${encodeURIComponent(job.id)}/result`, { signal })).blob();
    read = await readFile(file, filename);
  } catch (error) {
    if (signal.aborted || (error.status && !error.retryable)) throw error;
    hooks.onNote(`This page could not show ${filename} (${error.message}); download it to see it.`); // the job is done
    return null;
  }
  const { count, stride, xyz } = read;
  signal.throwIfAborted();
  if (cloud?.count !== count) {
    cloud = new Cloud({ count, stride });
    hooks.onCloud(cloud, `Only the result is shown, coloured by height. ${thinning(cloud)}`);
  }
  cloud.putAll(xyz);
  return cloud;
}

export function thinning(cloud) {
  if (cloud.stride === 1) return "";
  const ordinal = cloud.stride === 2 ? "second" : cloud.stride === 3 ? "third" : `${cloud.stride}th`;
  return `Every ${ordinal} point is shown; all of them are denoised.`;
}
