// Positions of a PLY file: text, and binary of both byte orders.

import { eachLine, isSpace, readColumns } from "./lines.js";

const KINDS = {
  char: "Int8", int8: "Int8", uchar: "Uint8", uint8: "Uint8", short: "Int16", int16: "Int16", ushort: "Uint16", uint16: "Uint16",
  int: "Int32", int32: "Int32", uint: "Uint32", uint32: "Uint32", float: "Float32", float32: "Float32", double: "Float64",
  float64: "Float64", int64: "BigInt64", uint64: "BigUint64",
};
const HEADER_BYTES = 1 << 20;

export function readPly(bytes) {
  const { encoding, elements, size } = header(bytes);
  const at = elements.findIndex((element) => element.name === "vertex");
  if (at < 0) throw new Error("no element vertex");
  const vertex = elements[at];
  const axes = axesAmong(vertex.properties.map((property) => property.name));
  if (axes.includes(-1)) throw new Error("no x, y, z");
  if (encoding === "ascii") return asciiRows(bytes, size, elements.slice(0, at), vertex, axes);
  return binaryRows(bytes, size, elements.slice(0, at), vertex, axes, encoding === "binary_little_endian");
}

// Where x y z are, or X Y Z where there are those alone.
function axesAmong(names) {
  const isSmall = ["x", "y", "z"].some((axis) => names.includes(axis));
  return (isSmall ? ["x", "y", "z"] : ["X", "Y", "Z"]).map((axis) => names.indexOf(axis));
}

function header(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, HEADER_BYTES));
  const end = /(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r)/.exec(text);
  if (!text.startsWith("ply") || !end) throw new Error("no PLY header");
  let encoding = "";
  const elements = [];
  for (const line of text.slice(0, end.index).split(/\r\n|\n|\r/)) {
    const [keyword, ...rest] = line.trim().split(/\s+/);
    if (keyword === "format") encoding = rest[0];
    else if (keyword === "element") elements.push({ name: rest[0], count: Number(rest[1]), properties: [] });
    else if (keyword === "property") elements.at(-1).properties.push(property(rest));
  }
  return { encoding, elements, size: end.index + end[0].length };
}

function property(rest) {
  const [counter, kind, name] = rest[0] === "list" ? [KINDS[rest[1]], KINDS[rest[2]], rest[3]] : [null, KINDS[rest[0]], rest[1]];
  if (!kind || counter === undefined) throw new Error(`${rest.join(" ")} is no property`);
  return { name, kind, bytes: widthOf(kind), counter, counterBytes: counter ? widthOf(counter) : 0 };
}

function widthOf(kind) {
  return Number(/\d+$/.exec(kind)[0]) / 8;
}

function asciiRows(bytes, begin, before, vertex, axes) {
  if (vertex.properties.some((property, index) => property.counter && index < Math.max(...axes))) {
    throw new Error("lists before x, y, z");
  }
  const xyz = new Float64Array(3 * vertex.count);
  let skipped = before.reduce((total, element) => total + element.count, 0);
  let row = 0;
  eachLine(bytes, begin, (text, start, end) => {
    if (row === vertex.count) return true;
    while (start < end && isSpace(text.charCodeAt(start))) start++;
    if (start === end) return false;
    if (skipped > 0) skipped--;
    else readColumns(text, start, end, 0, axes, xyz, 3 * row++);
    return false;
  });
  if (row < vertex.count) throw new Error("the file ends early");
  return xyz;
}

function binaryRows(bytes, begin, before, vertex, axes, isLittle) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let at = begin;
  for (const element of before) {
    if (element.properties.some((property) => property.counter)) {
      for (let row = 0; row < element.count; row++) at += rowBytes(view, at, element.properties, isLittle, null);
    } else {
      at += element.count * rowBytes(view, at, element.properties, isLittle, null);
    }
  }
  const xyz = new Float64Array(3 * vertex.count);
  const offsets = new Array(vertex.properties.length).fill(0);
  const isEven = !vertex.properties.some((property) => property.counter);
  const step = rowBytes(view, at, vertex.properties, isLittle, offsets);
  const getters = axes.map((index) => view[`get${vertex.properties[index].kind}`].bind(view));
  for (let row = 0; row < vertex.count; row++) {
    const size = isEven ? step : rowBytes(view, at, vertex.properties, isLittle, offsets);
    for (let axis = 0; axis < 3; axis++) xyz[3 * row + axis] = getters[axis](at + offsets[axes[axis]], isLittle);
    at += size;
  }
  return xyz;
}

// Return the size of the row at `at`, and where its properties begin.
function rowBytes(view, at, properties, isLittle, offsets) {
  let size = 0;
  properties.forEach((property, index) => {
    if (offsets) offsets[index] = size;
    if (property.counter) {
      size += property.counterBytes + Number(view[`get${property.counter}`](at + size, isLittle)) * property.bytes;
    } else {
      size += property.bytes;
    }
  });
  return size;
}
