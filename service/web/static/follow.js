// Follow one job from its id to its end: events for the words, patches for the picture.

import { call } from "./api.js";
import { Cloud } from "./cloud.js";
import { watchJob } from "./events.js";
import { watchPatches } from "./patches.js";
import { canRead, readFile } from "./read/reader.js";

const REFRESH_MS = 250;
const REFRESH_MS_PER_MILLION = 750;

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
  const onFrame = (frame) => {
    cloud.put(frame.rows, frame.xyz);
    soon();
  };

  const ended = new AbortController();
  const patches = watchPatches(id, { onHeader, onFrame, isOver: () => isOver }, AbortSignal.any([signal, ended.signal])).catch(() => false);
  try {
    const job = await watchJob(id, hooks.onEvent, signal);
    isOver = true;
    if (job.state !== "succeeded") return job;
    if (!(await patches) && !signal.aborted) cloud = (await fromResult(job, cloud, hooks, signal)) ?? cloud;
    clearTimeout(timer);
    if (cloud && !signal.aborted) hooks.onPoints({ isWhole: true });
    return job;
  } finally {
    ended.abort();
    clearTimeout(timer);
  }
}

// The patches are gone or broke off: take the positions from the result's file, where the page can read it.
async function fromResult(job, cloud, hooks, signal) {
  const { filename, bytes } = job.result;
  if (!canRead(filename, bytes)) {
    hooks.onNote(`This page cannot read ${filename}; download it to see it.`);
    return null;
  }
  const file = await (await call(`jobs/${encodeURIComponent(job.id)}/result`, { signal })).blob();
  const { count, stride, xyz } = await readFile(file, filename);
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
