// Text tables, line by line, without holding the whole text as one string.

const BLOCK = 1 << 22;
export const NUMBER = /^[-+]?((\d+\.?\d*|\.\d+)(e[-+]?\d+)?|nan(\((ind|snan)\))?|inf(inity)?|1\.#(ind|inf|[qs]nan)0*)$/i;
export const MISSING = ["", "na", "null"]; // a cell of a delimited table without a number

// Call visit(text, start, end) for every line behind byte `begin`, until it returns true.
export function eachLine(bytes, begin, visit) {
  const decoder = new TextDecoder("latin1");
  while (begin < bytes.length) {
    let end = Math.min(begin + BLOCK, bytes.length);
    while (end < bytes.length && bytes[end - 1] !== 10) end++;
    const text = decoder.decode(bytes.subarray(begin, end));
    for (let at = 0; at < text.length; ) {
      let stop = at;
      while (stop < text.length && text.charCodeAt(stop) !== 10 && text.charCodeAt(stop) !== 13) stop++;
      if (visit(text, at, stop)) return;
      at = text.charCodeAt(stop) === 13 && text.charCodeAt(stop + 1) === 10 ? stop + 2 : stop + 1;
    }
    begin = end;
  }
}

export function isSpace(code) {
  return code === 32 || (code >= 9 && code <= 13) || code === 26; // Ctrl-Z, how DOS ends a file
}

// Read the numbers of some columns into out[at...], NaN for a missing one; delimiter: a character code, or 0 for white space.
export function readColumns(text, start, end, delimiter, columns, out, at) {
  const last = Math.max(...columns);
  const isEnd = delimiter === 0 ? isSpace : (code) => code === delimiter;
  const quotes = delimiter === 0 ? 0 : text.slice(start, end).split('"').length - 1;
  const isPaired = quotes > 0 && quotes % 2 === 0;
  let cursor = start;
  for (let column = 0; column <= last; column++) {
    if (delimiter === 0) while (cursor < end && isSpace(text.charCodeAt(cursor))) cursor++;
    if (cursor > end || (cursor === end && delimiter === 0)) throw new Error("a line has too few columns");
    let stop = cursor;
    for (let isQuoted = false; stop < end && (isQuoted || !isEnd(text.charCodeAt(stop))); stop++) {
      if (isPaired && text.charCodeAt(stop) === 34) isQuoted = !isQuoted;
    }
    for (let axis = 0; axis < columns.length; axis++) {
      if (columns[axis] === column) out[at + axis] = numberIn(text.slice(cursor, stop), delimiter, quotes > 0);
    }
    cursor = delimiter === 0 ? stop : stop + 1;
  }
}

function numberIn(cell, delimiter, hasQuotes) {
  const bare = hasQuotes ? cell.replace(/^["\s]+|["\s]+$/g, "") : cell.trim();
  const value = bare ? Number(bare) : NaN;
  if (Number.isNaN(value) && !NUMBER.test(bare) && !(delimiter && MISSING.includes(bare.toLowerCase()))) {
    throw new Error(`${bare.slice(0, 40)} is no number`);
  }
  return value;
}

// A Float64Array that grows.
export class Rows {
  constructor(room = 1 << 16) {
    this.values = new Float64Array(3 * room);
    this.count = 0;
  }

  next() {
    if (3 * this.count === this.values.length) {
      const grown = new Float64Array(2 * this.values.length);
      grown.set(this.values);
      this.values = grown;
    }
    return 3 * this.count++;
  }

  get xyz() {
    return this.values.subarray(0, 3 * this.count);
  }
}
