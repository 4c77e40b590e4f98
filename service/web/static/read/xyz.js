// Positions of a text table (.xyz .csv .tsv .pts and the like), by the rules of points/formats/xyz.py and titles.py.

import { MISSING, NUMBER, Rows, eachLine, isSpace, readColumns } from "./lines.js";

export const MARKS = [";", ","]; // what may stand between cells where it is not white space: the first that a row has
const POSITIONS = [
  ["x", "y", "z"],
  ["points:0", "points:1", "points:2"],
  ["points_0", "points_1", "points_2"],
  ["points_m_xyz:0", "points_m_xyz:1", "points_m_xyz:2"],
  ["points_m_xyz_0", "points_m_xyz_1", "points_m_xyz_2"],
  ["point_x", "point_y", "point_z"],
  ["px", "py", "pz"],
  ["pos_x", "pos_y", "pos_z"],
  ...["elevation", "height", "altitude", "z"].map((height) => ["easting", "northing", height]),
  ...["elev", "elevation", "height", "z"].map((height) => ["east", "north", height]),
  ["e", "n", "z"],
  ...["_m", " coordinate", "_coordinate", " coord", "_coord"].map((more) => ["x", "y", "z"].map((axis) => axis + more)),
  ["x1", "y1", "z1"],
  ["0", "1", "2"],
];
const VALUE = /^[-+.]?\d[\d.,]*[^\w:-]*[A-Za-z]{0,2}$/; // 48.1, 0..360, 120m: no name of a column, as 1_lat is
const DEGREES = [["lat", "latitude"], ["lon", "lng", "long", "longitude"]];
const POLAR = [
  ["azimuth", "azimuthal", "azim", "az", "bearing", "theta", "phi"],
  ["range", "distance", "dist", "radius", "r", "rho", "elevation", "elev", "el", "zenith", "inclination"],
];
const UNIT = /\s*(\[.*\]|\(.*\))$/;
const BEFORE_UNIT = /(?<!\s)\s+(?=[[(])/g;
const LEAD = /^[^,;\t:]*:\s+/; // columns: x y z
const PAIRS = /^[ \t-\r]*[-+]?\d+,\d+(,[ \t-\r]*[-+]?\d+,\d+){2,}[ \t-\r]*$/; // 0,5, 1,5, 2,5
const DECIMAL_COMMAS = /^[-+]?\d+(,\d+)?([ \t-\r]+[-+]?\d+(,\d+)?){2,}$/; // 0,5 1 2,5: not between commas
const SEPARATOR = /^"?sep=.?"?$/i; // Excel's first line
const REMARKS = 20; // the last comments above a table, of which one may be its title
const COUNTED = 10; // points: of fewer, an x may go up by one each
const LOOKED_AT = 1 << 14; // bytes of the first rows, which tell decimal commas from cells
const TAB = 9;
const COMMA = 44;
const NO_COMMA = "decimals have a point here, no comma";
const UNKNOWN_NAMES = "names that do not say x, y, z";

export function readXyz(bytes, marks = MARKS) {
  const rows = new Rows();
  let table = null;
  let declared = null;
  let names = "";
  const remarks = []; // the last one first
  const begin = bytes[0] === 0xef && bytes[1] === 0xbb && bytes[2] === 0xbf ? 3 : 0;
  let numbered = null; // a line that is pandas' 0, 1, 2... or a point: the next one tells
  let counting = null; // whether x only counts the points, of a table without names
  let numbering = null; // whether x and y number a scanner's rows and columns there
  let pairs = null; // its first rows, where commas are between cells
  const row = (text, start, end) => {
    const at = rows.next(); // may replace rows.values
    readColumns(text, start, end, table.delimiter, table.axes, rows.values, at);
    if (counting?.isSo) counting.add(rows.values[at], text.slice(start, end));
    if (numbering?.isSo) numbering.add(rows.values.subarray(at, at + 3), text.slice(start, end));
    if (pairs?.left > 0) pairs.add(text.slice(start, end));
  };
  const below = (line) => {
    table = layout(line, names, remarks, marks);
    if (table.isNamed || declared !== null) return;
    counting = new Counting(table.delimiter);
    numbering = new Numbering(table.delimiter);
    if (table.delimiter === COMMA) pairs = new Pairs();
  };
  const above = (text, start, end, line, isComment) => {
    if (!line) return;
    if (isComment || SEPARATOR.test(line)) {
      remarks.unshift(line.replace(/^[#/ ]+/, ""));
      remarks.length = Math.min(remarks.length, REMARKS);
    } else if (declared === null && !names && /^\d{1,18}$/.test(line)) declared = Number(line);
    else if (!names && areNames(line, marks)) names = line.replace(/^[% ]+/, "");
    else if (!names && numbered === null && areNumbers(line, marks)) numbered = { text, start, end, line };
    else below(line);
  };
  const decide = (following) => {
    const { text, start, end, line } = numbered;
    if (goesUnder(line, following, marks)) names = line;
    else {
      below(line);
      row(text, start, end);
    }
    numbered = null;
  };
  eachLine(bytes, begin, (text, start, end) => {
    if (numbered) decide(bare(text.slice(start, end), marks));
    const isTabbed = table ? table.delimiter === TAB : marks.includes("\t"); // a tab at the start is behind an empty cell
    while (start < end && isSpace(text.charCodeAt(start)) && !(isTabbed && text.charCodeAt(start) === TAB)) start++;
    if (start === end) return;
    const isComment = text[start] === "#" || (text[start] === "/" && text[start + 1] === "/");
    if (table === null) above(text, start, end, bare(text.slice(start, end), marks), isComment);
    // One number below a number of points is that of one more scan.
    if (table === null || isComment || (declared !== null && /^[^ \t-\r,;]+\s*$/.test(text.slice(start, end)))) return;
    row(text, start, end);
  });
  if (numbered) decide("");
  if (pairs?.areDecimals) throw new Error(NO_COMMA);
  if (counting?.isRefused) throw new Error("the first column counts the points, and nothing says which are x, y, z");
  if (numbering?.isRefused) throw new Error("the first columns number rows and columns, and nothing says which are x, y, z");
  return rows.xyz;
}

// As the server does, which refuses such a table: whether a first column counts the points, beside a fourth of numbers.
class Counting {
  constructor(delimiter) {
    this.marks = delimiter ? [String.fromCharCode(delimiter)] : [];
    this.isSo = true;
    this.hasFourth = false;
    this.first = null;
    this.count = 0;
  }

  add(x, line) {
    const cell = words(line, this.marks)[3] ?? "";
    const isNumber = NUMBER.test(cell) || (this.marks.length > 0 && MISSING.includes(cell.toLowerCase()));
    this.first ??= x;
    this.isSo = isNumber && Number.isInteger(this.first) && x === this.first + this.count++;
    this.hasFourth ||= cell !== "";
  }

  get isRefused() {
    return this.isSo && this.hasFourth && this.count >= COUNTED;
  }
}

// As the server does: whether the first two columns, whole numbers in the order of one of them, number a scanner's rows
// and columns, beside three that have decimals in most rows.
class Numbering {
  constructor(delimiter) {
    this.marks = delimiter ? [String.fromCharCode(delimiter)] : [];
    this.isSo = true;
    this.orders = new Set(["0+", "0-", "1+", "1-"]); // of which columns, up or down, that were kept so far
    this.decimals = [0, 0, 0];
    this.last = null;
    this.count = 0;
  }

  add([first, second, third], line) {
    const cells = words(line, this.marks);
    const behind = cells.slice(3, 5);
    const areNumbers = behind.every((cell) => NUMBER.test(cell) || (this.marks.length > 0 && MISSING.includes(cell.toLowerCase())));
    const numbers = [first, second];
    const areWhole = numbers.every((number) => Number.isInteger(number) && number >= 0);
    this.isSo = behind.length === 2 && areNumbers && areWhole && (this.last !== null || cells.slice(0, 2).every((cell) => /^\d+$/.test(cell)));
    for (const column of this.last ? [0, 1] : []) {
      if (numbers[column] < this.last[column]) this.orders.delete(`${column}+`);
      if (numbers[column] > this.last[column]) this.orders.delete(`${column}-`);
    }
    this.isSo &&= this.orders.size > 0;
    [third, ...behind.map(Number)].forEach((value, column) => (this.decimals[column] += value % 1 ? 1 : 0)); // NaN has none
    this.last = numbers;
    this.count++;
  }

  get isRefused() {
    return this.isSo && this.count >= COUNTED && this.decimals.every((some) => some > this.count / 2);
  }
}

// As the server does: whether rows read as numbers with decimal commas that commas separate.
class Pairs {
  constructor() {
    this.rows = [];
    this.left = LOOKED_AT;
  }

  add(line) {
    this.left -= line.length + 1;
    if (this.left >= 0 || this.rows.length === 0) this.rows.push(line);
  }

  get areDecimals() {
    if (!this.rows.every((row) => PAIRS.test(row))) return false;
    const marks = this.rows.flatMap((row) => [...row.matchAll(/\d+,\d+(,[ \t-\r]*)/g)]);
    if (marks.every(([, mark]) => mark.length > 1)) return true;
    const decimals = this.rows.flatMap((row) => row.split(",").filter((_, cell) => cell % 2)).map(strip);
    const areAsLong = decimals.every((cell) => cell.length === decimals[0].length);
    return areAsLong && decimals[0].length > 1 && decimals.some((cell) => cell.startsWith("0"));
  }
}

function layout(line, names, remarks, marks) {
  const cells = words(line, marks);
  const delimiter = (delimiterOf(line, marks) ?? "\0").charCodeAt(0);
  if ((names || cells.length < 3) && delimiter === COMMA && DECIMAL_COMMAS.test(line)) throw new Error(NO_COMMA);
  for (const title of [names, ...remarks]) {
    const fitting = meant(title, marks).map((labels) => fitted(labels, cells)).filter((labels) => labels !== null);
    const axes = fitting.map(axesOf).find((found) => found !== null);
    if (axes) return { delimiter, axes, isNamed: true };
    if (fitting.some((labels) => hold(DEGREES, labels) || hold(POLAR, labels))) throw new Error(UNKNOWN_NAMES);
    const isRefused = fitting.length > 0 || meant(title, marks).some((labels) => axesOf(labels) !== null);
    if (title && title === names && cells.length > 3 && isRefused) throw new Error(UNKNOWN_NAMES);
  }
  return { delimiter, axes: [0, 1, 2], isNamed: false };
}

// No distance can be told in latitude and longitude, nor in azimuth and elevation: whether something of every set is there.
// `lat 48.1 long 9.2`, where a scanner stood, is none of names.
function hold(sets, labels) {
  if (labels.some((label) => VALUE.test(label))) return false;
  const plain = labels.flatMap((label) => label.replace(UNIT, "").toLowerCase().split(/[^a-z]+/));
  return sets.every((names) => names.some((name) => plain.includes(name)));
}

// The names in a title as they may be meant: `x [m]` as one, `Point Id` between tabs, `columns: x y z`.
function meant(title, marks) {
  if (!title) return [];
  const ways = [];
  for (const text of [title, title.replace(LEAD, "")]) {
    ways.push(words(text, marks));
    if (delimiterOf(text, marks) === undefined) ways.push(text.split("\t"), words(text.replace(BEFORE_UNIT, ""), marks));
  }
  return ways.map((labels) => labels.map((label) => label.replace(/^["' ]+|["' ]+$/g, "")));
}

// A name for each cell of a row, or null; a delimiter at the end of either is no column of its own.
function fitted(labels, cells) {
  if (labels.length === cells.length + 1 && !labels.at(-1)) return labels.slice(0, -1);
  if (labels.length === cells.length - 1 && !cells.at(-1)) return [...labels, ""];
  return labels.length === cells.length ? labels : null;
}

// Which of the columns so named are x, y and z, where each is named once: so written, or in any case.
function axesOf(labels) {
  const plain = labels.map((label) => label.replace(UNIT, ""));
  for (const cased of [plain, plain.map(swapcase), plain.map((label) => label.toLowerCase())]) {
    const isOnce = (name) => cased.includes(name) && cased.indexOf(name) === cased.lastIndexOf(name);
    const three = POSITIONS.find((some) => some.every(isOnce));
    if (three) return three.map((name) => cased.indexOf(name));
  }
  return null;
}

function swapcase(label) {
  return label.replace(/[a-z]/gi, (letter) => (letter < "a" ? letter.toLowerCase() : letter.toUpperCase()));
}

function delimiterOf(line, marks) {
  const unquoted = byQuotes(line).filter((_, part) => part % 2 === 0).join("");
  return marks.find((mark) => unquoted.includes(mark));
}

// White space as the server has it: not what is one in Latin-1 only, half of a letter in UTF-8.
function strip(text) {
  return text.replace(/^[ \t-\r]+|[ \t-\r]+$/g, "");
}

// The same, but for tabs that stand beside an empty cell.
function bare(text, marks) {
  return marks.includes("\t") && strip(text) ? text.replace(/^[ \n-\r]+|[ \n-\r]+$/g, "") : strip(text);
}

// The cells of a line, their quotes taken off.
function words(line, marks) {
  const mark = delimiterOf(line, marks);
  if (!mark) return strip(line) ? strip(line).split(/[ \t-\r]+/) : [];
  const parts = byQuotes(line).map((part, number) => (number % 2 ? part.replaceAll(mark, "\0") : part));
  return parts.join('"').split(mark).map((word) => word.replaceAll("\0", mark).replace(/^[" \t-\r]+|[" \t-\r]+$/g, ""));
}

// Every second part is quoted; one part where quotes are not in pairs.
function byQuotes(line) {
  const parts = line.split('"');
  return parts.length % 2 ? parts : [line];
}

function areNames(line, marks) {
  const labels = words(line, marks);
  const hasGaps = delimiterOf(line, marks) && labels.every((label) => MISSING.includes(label.toLowerCase()));
  if (labels.length < 3 || hasGaps) return false;
  return !labels.some((label) => NUMBER.test(label)) || namesAxes(line, marks);
}

// Whether a line names x, y and z in words, whatever else it names: 450 and 550, of wavelengths.
function namesAxes(line, marks) {
  return meant(line, marks).some((labels) => axesOf(labels) && !/^\d+$/.test(labels[axesOf(labels)[0]]));
}

// 0, 1, 2..., behind the empty name of an index perhaps.
function areNumbers(line, marks) {
  const labels = words(line, marks);
  const lead = labels[0] === "" ? 1 : 0;
  return labels.length >= lead + 3 && labels.slice(lead).every((label, column) => label === String(column));
}

// Whether a line is one of numbers of columns: the row under it has as many cells, and no position is a whole number.
function goesUnder(line, following, marks) {
  const [labels, cells] = [line, following].map((text) => words(text, marks));
  const lead = labels[0] === "" ? 1 : 0;
  return cells.length === labels.length && !cells.slice(lead, lead + 3).some((cell) => /^[-+]*\d+$/.test(cell));
}
