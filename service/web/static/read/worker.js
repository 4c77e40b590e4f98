// Reads a file away from the page's own thread: {id, file, name} in, {id, count, stride, xyz} or {id, error} out.

import { readPositions, strideFor, thinned } from "./index.js";

addEventListener("message", async ({ data: { id, file, name } }) => {
  try {
    const all = readPositions(new Uint8Array(await file.arrayBuffer()), name);
    const stride = strideFor(all.length / 3);
    const xyz = thinned(all, stride);
    postMessage({ id, count: all.length / 3, stride, xyz }, [xyz.buffer]);
  } catch (error) {
    postMessage({ id, error: String(error.message ?? error) });
  }
});
