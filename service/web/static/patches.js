// The patch stream (application/vnd.straightpcf.patches, docs/api.md): finished patches as the server makes them.

import { call, pause } from "./api.js";

export const MEDIA_TYPE = "application/vnd.straightpcf.patches";

const HEADER_BYTES = 16;
const FRAME_BYTES = 16; // length, iteration, flags, progress, n
const POINT_BYTES = 28;
const MAX_FRAME_POINTS = 2 ** 24;
const END = 2;
const PAUSE_MS = 1_000;

// Call onHeader(N) and onFrame(frame) until the end frame; false if the stream has ended for good without one.
export async function watchPatches(id, { onHeader, onFrame, isOver }, signal) {
  for (;;) {
    try {
      const response = await call(`jobs/${encodeURIComponent(id)}/stream`, { headers: { Accept: MEDIA_TYPE }, signal });
      const reader = response.body.getReader();
      const parser = new PatchParser();
      for (;;) {
        const { done, value } = await reader.read();
        if (done) break;
        const isNew = parser.points === null;
        const frames = parser.feed(value);
        if (isNew && parser.points !== null) onHeader(parser.points);
        for (const frame of frames) {
          if (frame.isEnd) return true;
          onFrame(frame);
        }
      }
    } catch (error) {
      if (signal.aborted) throw error;
      if (error instanceof RangeError || (error.status && !error.retryable)) return false;
    }
    if (isOver()) return false;
    await pause(PAUSE_MS, signal); // it begins anew: the same rows come again, with the same positions
  }
}

// Turns bytes into frames {iteration, isEnd, progress, rows: Uint32Array (n), xyz: Float64Array (3 n)}.
export class PatchParser {
  constructor() {
    this.points = null;
    this.buffer = new Uint8Array(1 << 16);
    this.used = 0;
  }

  feed(bytes) {
    this.append(bytes);
    const view = new DataView(this.buffer.buffer);
    let at = 0;
    if (this.points === null) {
      if (this.used < HEADER_BYTES) return [];
      const isOurs = view.getUint32(0, false) === 0x53504350 && view.getUint16(4, true) === 1;
      if (!isOurs) throw new RangeError("not a patch stream of version 1");
      this.points = Number(view.getBigUint64(8, true));
      at = HEADER_BYTES;
    }
    const frames = [];
    while (this.used - at >= FRAME_BYTES) {
      const length = view.getUint32(at, true);
      const count = view.getUint32(at + 12, true);
      if (count > MAX_FRAME_POINTS || length !== FRAME_BYTES - 4 + count * POINT_BYTES) throw new RangeError("a broken patch frame");
      if (this.used - at < 4 + length) break;
      const rows = at + FRAME_BYTES;
      const xyz = rows + 4 * count;
      // Copies, because a view must begin at a multiple of its item.
      frames.push({
        iteration: view.getUint16(at + 4, true),
        isEnd: (view.getUint16(at + 6, true) & END) !== 0,
        progress: view.getFloat32(at + 8, true),
        rows: new Uint32Array(this.buffer.buffer.slice(rows, xyz)),
        xyz: new Float64Array(this.buffer.buffer.slice(xyz, xyz + 24 * count)),
      });
      at += 4 + length;
    }
    this.buffer.copyWithin(0, at, this.used);
    this.used -= at;
    return frames;
  }

  append(bytes) {
    if (this.used + bytes.length > this.buffer.length) {
      const grown = new Uint8Array(2 * (this.used + bytes.length));
      grown.set(this.buffer.subarray(0, this.used));
      this.buffer = grown;
    }
    this.buffer.set(bytes, this.used);
    this.used += bytes.length;
  }
}
