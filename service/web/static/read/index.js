// Which files this page can read by itself; all others go to the server unseen.

import { readNpy } from "./npy.js";
import { readPly } from "./ply.js";
import { MARKS, readXyz } from "./xyz.js";

const TEXT = [".xyz", ".txt", ".asc", ".xyzn", ".xyzrgb", ".csv", ".tsv", ".pts"];

// The ten lines above a scan of a PTX file, by points/formats/ptx.py; its matrix places the points.
const NUMBERS = (count) => String.raw`[ \t]*[-+.\deE]+(?:[ \t]+[-+.\deE]+){${count - 1}}[ \t]*\r?\n`;
const PTX = new RegExp(String.raw`^(?:[ \t]*\d+[ \t]*\r?\n){2}(?:${NUMBERS(3)}){4}(?:${NUMBERS(4)}){4}`);
const HEAD_BYTES = 4096;

export const READABLE = [".ply", ".npy", ...TEXT];
export const MAX_READ_BYTES = 1 << 30;
export const MAX_SHOWN = 2_000_000;

export function suffixOf(name) {
  return name.includes(".") ? name.slice(name.lastIndexOf(".")).toLowerCase() : "";
}

// Return (3 N) positions; a file is what its first bytes say, as on the server.
export function readPositions(bytes, name) {
  if (bytes[0] === 0x93 && bytes[1] === 0x4e && bytes[2] === 0x55) return readNpy(bytes);
  const hasMark = bytes[0] === 0xef && bytes[1] === 0xbb && bytes[2] === 0xbf; // of byte order
  const bare = hasMark ? bytes.subarray(3) : bytes;
  if (bare[0] === 0x70 && bare[1] === 0x6c && bare[2] === 0x79 && bare[3] <= 32) return readPly(bare);
  const isPtx = PTX.test(new TextDecoder("latin1").decode(bytes.subarray(0, HEAD_BYTES)));
  if (TEXT.includes(suffixOf(name)) && !isPtx) return readXyz(bytes, suffixOf(name) === ".tsv" ? ["\t", ...MARKS] : MARKS);
  throw new Error("a format that this page does not read");
}

export function strideFor(count) {
  return Math.max(1, Math.ceil(count / MAX_SHOWN));
}

// Keep every stride-th row.
export function thinned(xyz, stride) {
  if (stride === 1) return xyz.slice();
  const kept = new Float64Array(3 * Math.ceil(xyz.length / 3 / stride));
  for (let row = 0, at = 0; at < kept.length; row += stride, at += 3) {
    kept[at] = xyz[3 * row];
    kept[at + 1] = xyz[3 * row + 1];
    kept[at + 2] = xyz[3 * row + 2];
  }
  return kept;
}
