// Positions of a text table (.xyz .txt .asc .csv .pts), by the rules of points/formats/xyz.py.

import { Rows, eachLine, isSpace, readColumns } from "./lines.js";

const POSITIONS = [
  ["x", "y", "z"],
  ["points:0", "points:1", "points:2"],
  ["px", "py", "pz"],
  ["pos_x", "pos_y", "pos_z"],
  ...["elevation", "height", "altitude", "z"].map((height) => ["easting", "northing", height]),
];
const UNIT = /\s*(\[.*\]|\(.*\))$/;

export function readXyz(bytes) {
  const rows = new Rows();
  let table = null;
  let declared = null;
  let names = "";
  let remark = "";
  const begin = bytes[0] === 0xef && bytes[1] === 0xbb && bytes[2] === 0xbf ? 3 : 0;
  eachLine(bytes, begin, (text, start, end) => {
    while (start < end && isSpace(text.charCodeAt(start))) start++;
    if (start === end) return;
    const isComment = text[start] === "#" || (text[start] === "/" && text[start + 1] === "/");
    if (table === null) {
      const line = text.slice(start, end).trim();
      if (isComment) remark = line.replace(/^[#/ ]+/, "");
      else if (declared === null && !names && /^\d{1,18}$/.test(line)) declared = Number(line);
      else if (!names && areNames(words(line))) names = line;
      else table = layout(line, names, remark);
    }
    if (table !== null && !isComment) {
      const at = rows.next(); // may replace rows.values
      readColumns(text, start, end, table.delimiter, table.axes, rows.values, at);
    }
  });
  return rows.xyz;
}

function layout(line, names, remark) {
  const columns = words(line).length;
  const delimiter = line.includes(";") ? 59 : line.includes(",") ? 44 : 0;
  for (const title of [names, remark]) {
    const labels = words(title).map((word) => word.replace(/^["' ]+|["' ]+$/g, "").toLowerCase().replace(UNIT, ""));
    if (labels.length !== columns) continue;
    for (const names of POSITIONS) {
      const axes = names.map((name) => labels.indexOf(name));
      if (axes.every((axis) => axis >= 0)) return { delimiter, axes };
    }
  }
  return { delimiter, axes: [0, 1, 2] };
}

function words(line) {
  const mark = line.includes(";") ? ";" : line.includes(",") ? "," : /\s+/;
  return line.trim() ? line.trim().split(mark).map((word) => word.trim()) : [];
}

function areNames(labels) {
  return labels.length >= 3 && labels.every((word) => word === "" || !/^[-+]?(\d|\.\d|nan$|inf)/i.test(word));
}
