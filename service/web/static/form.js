// The form: what the server takes, the chosen file, the options as a query.

import { element } from "./report.js";
import * as text from "./text.js";

export class Form {
  // parts: the page's elements by id; onFile(file): one was chosen; onFault(line): what was dropped cannot be.
  constructor(parts, onFile, onFault) {
    this.parts = parts;
    this.file = null;
    this.info = null;
    const choose = ([file, ...more]) => {
      if (!file) return;
      this.file = file;
      parts.chosen.textContent = file.name;
      const others = more.length ? `the first of ${more.length + 1} files, which go one at a time` : "choose another or drop it here";
      parts["chosen-note"].textContent = `${text.bytes(file.size)} · ${others}`;
      onFile(file);
    };
    parts.file.addEventListener("change", () => choose(parts.file.files));
    parts.file.addEventListener("click", () => (parts.file.value = "")); // else the same file again is no change
    parts.strength.addEventListener("input", () => this.showStrength());
    addEventListener("pageshow", () => this.showStrength()); // by then browsers have restored a form's values
    for (const kind of ["dragenter", "dragover"]) {
      addEventListener(kind, (event) => {
        if (!hasFiles(event)) return;
        event.preventDefault();
        parts.drop.classList.add("over");
      });
    }
    addEventListener("dragleave", (event) => {
      if (!event.relatedTarget) parts.drop.classList.remove("over");
    });
    addEventListener("drop", (event) => {
      if (!hasFiles(event)) return; // text goes where it is dropped
      event.preventDefault();
      parts.drop.classList.remove("over");
      const { items, files } = event.dataTransfer;
      const folder = [...items].map((item) => item.webkitGetAsEntry?.()).find((entry) => entry?.isDirectory);
      if (folder) onFault(`${folder.name} is a folder; drop the files in it, one at a time.`);
      else choose(files);
    });
  }

  showInfo(info) {
    this.info = info;
    const { parts } = this;
    const suffixes = info.formats.flatMap((format) => format.suffixes);
    parts.limits.textContent =
      `${suffixes.map((suffix) => suffix.slice(1)).join(", ")}; up to ${text.bytes(info.max_bytes)} and ${text.plural(info.max_points, "point")}.`;
    parts.file.accept = suffixes.join(",");
    parts.server.textContent = [`version ${info.version}`, info.devices.join(", ")].filter(Boolean).join(" · ");
    fill(parts.iterations, Array.from({ length: info.max_iterations }, (_, pass) => [String(pass + 1), String(pass + 1)]));
    fill(parts.format, info.formats.map((format) => [format.name, format.name.toUpperCase()]));
  }

  // What is wrong before anything is sent, and in which part; or null.
  fault() {
    const { file, seed } = this.parts;
    const size = this.file?.size;
    const most = this.info?.max_bytes ?? Infinity;
    if (!this.file) return { line: "Choose a file first.", part: file };
    if (size === 0) return { line: `${this.file.name} is empty.`, part: file };
    if (size > most) {
      return { line: `${this.file.name} has ${text.bytes(size)}; this server takes ${text.bytes(most)}.`, part: file };
    }
    if (!/^[0-9]+$/.test(seed.value)) { // 1e3 is a number to browsers
      return { line: `The seed is ${seed.value}; it must be a whole number in ${seed.min}..${seed.max}, in digits.`, part: seed };
    }
    return null;
  }

  query() {
    const { iterations, strength, seed, normals, format } = this.parts;
    const query = new URLSearchParams({
      filename: this.file.name, iterations: iterations.value, strength: strength.value, seed: seed.value,
    });
    if (normals.value !== "keep") query.set("normals", normals.value);
    if (format.value) query.set("format", format.value);
    return query;
  }

  showStrength() {
    this.parts["strength-value"].textContent = `${Math.round(100 * this.parts.strength.value)} %`;
  }
}

function hasFiles(event) {
  return event.dataTransfer?.types.includes("Files") ?? false;
}

function fill(select, options) {
  const { value } = select;
  select.replaceChildren(select.options[0], ...options.map(([name, label]) => element("option", label, { value: name })));
  select.value = [...select.options].some((option) => option.value === value) ? value : select.options[0].value;
}
