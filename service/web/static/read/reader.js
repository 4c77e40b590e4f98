// Ask the worker for a file's positions.

import { MAX_READ_BYTES, READABLE, suffixOf } from "./index.js";

let worker = null;
let next = 1;
const waiting = new Map();

export function canRead(name, size) {
  return READABLE.includes(suffixOf(name)) && size <= MAX_READ_BYTES;
}

// Resolve to {count, stride, xyz}, where xyz are (3 n) float64 of every stride-th row; reject with what is wrong.
export function readFile(file, name) {
  worker ??= started();
  const id = next++;
  return new Promise((resolve, reject) => {
    waiting.set(id, { resolve, reject });
    worker.postMessage({ id, file, name });
  });
}

function started() {
  const thread = new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
  thread.addEventListener("message", ({ data }) => {
    const { resolve, reject } = waiting.get(data.id);
    waiting.delete(data.id);
    if (data.error) reject(new Error(data.error));
    else resolve(data);
  });
  thread.addEventListener("error", () => {
    for (const { reject } of waiting.values()) reject(new Error("the page's reader broke off"));
    waiting.clear();
    worker = null;
  });
  return thread;
}
