// Text tables, line by line, without holding the whole text as one string.

const BLOCK = 1 << 22;

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
  return code === 32 || (code >= 9 && code <= 13);
}

// Read the numbers of some columns into out[at...]; delimiter: a character code, or 0 for white space.
export function readColumns(text, start, end, delimiter, columns, out, at) {
  const last = Math.max(...columns);
  let cursor = start;
  for (let column = 0; column <= last; column++) {
    if (delimiter === 0) while (cursor < end && isSpace(text.charCodeAt(cursor))) cursor++;
    let stop = cursor;
    while (stop < end && (delimiter === 0 ? !isSpace(text.charCodeAt(stop)) : text.charCodeAt(stop) !== delimiter)) stop++;
    if (stop === cursor) throw new Error("a line has too few columns");
    for (let axis = 0; axis < columns.length; axis++) {
      if (columns[axis] === column) out[at + axis] = Number(text.slice(cursor, stop));
    }
    cursor = delimiter === 0 ? stop : stop + 1;
  }
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
