// Positions of a text table (.xyz .txt .asc .csv .pts), by the rules of points/formats/xyz.py and titles.py.

import { Rows, eachLine, isSpace, readColumns } from "./lines.js";

const POSITIONS = [
  ["x", "y", "z"],
  ["points:0", "points:1", "points:2"],
  ["px", "py", "pz"],
  ["pos_x", "pos_y", "pos_z"],
  ...["elevation", "height", "altitude", "z"].map((height) => ["easting", "northing", height]),
];
const UNIT = /\s*(\[.*\]|\(.*\))$/;
const BEFORE_UNIT = /(?<!\s)\s+(?=[[(])/g;
const LEAD = /^[^,;\t:]*:\s+/; // columns: x y z
const NUMBER = /^[-+]?((\d+\.?\d*|\.\d+)(e[-+]?\d+)?|nan(\((ind|snan)\))?|inf(inity)?|1\.#(ind|inf|[qs]nan)0*)$/i;
const REMARKS = 20; // the last comments above a table, of which one may be its title

export function readXyz(bytes) {
  const rows = new Rows();
  let table = null;
  let declared = null;
  let names = "";
  const remarks = []; // the last one first
  const begin = bytes[0] === 0xef && bytes[1] === 0xbb && bytes[2] === 0xbf ? 3 : 0;
  eachLine(bytes, begin, (text, start, end) => {
    while (start < end && isSpace(text.charCodeAt(start))) start++;
    if (start === end) return;
    const isComment = text[start] === "#" || (text[start] === "/" && text[start + 1] === "/");
    if (table === null) {
      const line = strip(text.slice(start, end));
      if (isComment) {
        remarks.unshift(line.replace(/^[#/ ]+/, ""));
        remarks.length = Math.min(remarks.length, REMARKS);
      } else if (declared === null && !names && /^\d{1,18}$/.test(line)) declared = Number(line);
      else if (!names && areNames(words(line))) names = line.replace(/^[% ]+/, "");
      else table = layout(line, names, remarks);
    }
    if (table !== null && !isComment) {
      const at = rows.next(); // may replace rows.values
      readColumns(text, start, end, table.delimiter, table.axes, rows.values, at);
    }
  });
  return rows.xyz;
}

function layout(line, names, remarks) {
  const cells = words(line);
  const delimiter = (delimiterOf(line) ?? "\0").charCodeAt(0);
  for (const title of [names, ...remarks]) {
    const fitting = meant(title).map((labels) => fitted(labels, cells)).filter((labels) => labels !== null);
    const axes = fitting.map(axesOf).find((found) => found !== null);
    if (axes) return { delimiter, axes };
    const isRefused = fitting.length > 0 || meant(title).some((labels) => axesOf(labels) !== null);
    if (title && title === names && cells.length > 3 && isRefused) throw new Error("names that do not say x, y, z");
  }
  return { delimiter, axes: [0, 1, 2] };
}

// The names in a title as they may be meant: `x [m]` as one, `Point Id` between tabs, `columns: x y z`.
function meant(title) {
  if (!title) return [];
  const ways = [];
  for (const text of [title, title.replace(LEAD, "")]) {
    ways.push(words(text));
    if (delimiterOf(text) === undefined) ways.push(text.split("\t"), words(text.replace(BEFORE_UNIT, "")));
  }
  return ways.map((labels) => labels.map((label) => label.replace(/^["' ]+|["' ]+$/g, "")));
}

// A name for each cell of a row, or null; a delimiter at the end of either is no column of its own.
function fitted(labels, cells) {
  if (labels.length === cells.length + 1 && !labels.at(-1)) return labels.slice(0, -1);
  if (labels.length === cells.length - 1 && !cells.at(-1)) return [...labels, ""];
  return labels.length === cells.length ? labels : null;
}

// Which of the columns so named are x, y and z, where each is named once.
function axesOf(labels) {
  const plain = labels.map((label) => label.toLowerCase().replace(UNIT, ""));
  const isOnce = (name) => plain.includes(name) && plain.indexOf(name) === plain.lastIndexOf(name);
  const three = POSITIONS.find((some) => some.every(isOnce));
  return three ? three.map((name) => plain.indexOf(name)) : null;
}

function delimiterOf(line) {
  return [";", ","].find((mark) => line.includes(mark));
}

// White space as the server has it: not what is one in Latin-1 only, half of a letter in UTF-8.
function strip(text) {
  return text.replace(/^[ \t-\r]+|[ \t-\r]+$/g, "");
}

function words(line) {
  const text = strip(line);
  return text ? text.split(delimiterOf(text) ?? /[ \t-\r]+/).map(strip) : [];
}

function areNames(labels) {
  return labels.length >= 3 && !labels.some((label) => NUMBER.test(label));
}
