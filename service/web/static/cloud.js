// The points that are shown: before and after as the GPU takes them, and how far each one moved.

import { strideFor } from "./read/index.js";

export const UNKNOWN = -1e30; // no position after yet
const SAMPLE = 20_000;

export class Cloud {
  // before: (3 n) float64 of every stride-th row, or null if only the positions after will be known.
  constructor({ count, stride = strideFor(count), before = null }) {
    this.count = count;
    this.stride = stride;
    this.shown = Math.ceil(count / stride);
    this.exact = before;
    this.origin = before ? centreOf(before) : null;
    this.known = 0;
    // (4 n): position relative to the origin, and the measure that is coloured: moved distance, else height.
    this.after = new Float32Array(4 * this.shown).fill(UNKNOWN);
    this.before = new Float32Array(3 * this.shown);
    if (before) this.begin();
  }

  get hasBefore() {
    return this.exact !== null;
  }

  begin() {
    for (let slot = 0; slot < this.shown; slot++) {
      for (let axis = 0; axis < 3; axis++) {
        const value = this.exact[3 * slot + axis] - this.origin[axis];
        this.before[3 * slot + axis] = value;
        this.after[4 * slot + axis] = value;
      }
    }
  }

  // rows: (k) of the whole cloud; xyz: (3 k) float64.
  put(rows, xyz) {
    for (let item = 0; item < rows.length; item++) {
      if (rows[item] % this.stride === 0) this.place(rows[item] / this.stride, xyz, 3 * item);
    }
  }

  // xyz: (3 n) float64 of every stride-th row, as the reader gives them.
  putAll(xyz) {
    for (let slot = 0; slot < this.shown; slot++) this.place(slot, xyz, 3 * slot);
  }

  place(slot, xyz, at) {
    if (slot >= this.shown) return;
    this.origin ??= [xyz[at], xyz[at + 1], xyz[at + 2]];
    if (this.after[4 * slot + 3] === Math.fround(UNKNOWN)) this.known++;
    let squared = 0;
    for (let axis = 0; axis < 3; axis++) {
      const value = xyz[at + axis];
      this.after[4 * slot + axis] = value - this.origin[axis];
      if (this.exact) squared += (value - this.exact[3 * slot + axis]) ** 2;
      else this.before[3 * slot + axis] = value - this.origin[axis];
    }
    this.after[4 * slot + 3] = this.exact ? Math.sqrt(squared) : xyz[at + 2];
  }

  // The colours' ends: 0 to the 99th percentile of the moved distances; the 1st to the 99th of the heights.
  // The two may be equal.
  range() {
    const step = Math.max(1, Math.floor(this.shown / SAMPLE));
    const values = [];
    for (let slot = 0; slot < this.shown; slot += step) {
      const value = this.after[4 * slot + 3];
      if (value > UNKNOWN / 2) values.push(value);
    }
    if (values.length === 0) return null;
    const sorted = Float64Array.from(values).sort();
    const at = (share) => sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
    const low = this.hasBefore ? 0 : at(0.01);
    return { low, top: at(0.99) };
  }

  // Call visit(x, y, z) for some thousand points that have a position; not those at 0, 0, 0, which in a scan mean
  // "no data", but where there are no others.
  eachSample(visit) {
    const step = Math.max(1, Math.floor(this.shown / SAMPLE));
    const zero = this.origin?.map((value) => Math.fround(-value));
    const points = [];
    for (let slot = 0; slot < this.shown; slot += step) {
      const point = this.after.subarray(4 * slot, 4 * slot + 3);
      if (point[0] > UNKNOWN / 2 && point.every(Number.isFinite)) points.push(point);
    }
    const others = points.filter((point) => point.some((value, axis) => value !== zero[axis]));
    for (const point of others.length > 0 ? others : points) visit(...point);
  }

  // Centre and radius of what is there, relative to the origin: a box of the middle 99.8 %, so that strays do not count.
  // Points in one place have the radius 1.
  bounds() {
    const samples = [[], [], []];
    this.eachSample((...point) => point.forEach((value, axis) => samples[axis].push(value)));
    if (samples[0].length === 0) return null;
    const centre = [0, 0, 0];
    let radius = 0;
    for (let axis = 0; axis < 3; axis++) {
      const sorted = Float64Array.from(samples[axis]).sort();
      const low = sorted[Math.floor(0.001 * sorted.length)];
      const high = sorted[Math.ceil(0.999 * (sorted.length - 1))];
      centre[axis] = (low + high) / 2;
      radius += ((high - low) / 2) ** 2;
    }
    return { centre, radius: Math.sqrt(radius) || 1 };
  }
}

// The median of the finite points: what float32 has to carry stays small, also beside a row of zeros in a map's
// coordinates.
function centreOf(xyz) {
  const step = 3 * Math.max(1, Math.floor(xyz.length / 3 / SAMPLE));
  return [0, 1, 2].map((axis) => {
    const values = [];
    for (let item = axis; item < xyz.length; item += step) if (Number.isFinite(xyz[item])) values.push(xyz[item]);
    return values.length > 0 ? Float64Array.from(values).sort()[values.length >> 1] : 0;
  });
}
