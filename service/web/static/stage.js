// The viewer and what stands around it: legend, slider, point size, notes.

import { drawPalette } from "./colours.js";
import * as text from "./text.js";
import { Viewer } from "./viewer.js";

const GLIDE_MS = 450;
const COVERED = 0.6;
const [SMALLEST, LARGEST] = [1.5, 6];

export class Stage {
  constructor(parts) {
    this.parts = parts;
    this.cloud = null;
    try {
      this.viewer = new Viewer(parts.canvas);
    } catch {
      this.viewer = null;
      parts.empty.textContent = "This browser offers no WebGL 2, so the cloud cannot be shown. Denoising works all the same.";
      parts.tools.hidden = parts["canvas-keys"].hidden = true;
      return;
    }
    const dark = matchMedia("(prefers-color-scheme: dark)");
    const theme = () => {
      this.viewer.setTheme(dark.matches ? "dark" : "light");
      drawPalette(parts["legend-bar"], dark.matches ? "dark" : "light");
    };
    dark.addEventListener("change", theme);
    theme();
    parts.blend.addEventListener("input", () => this.blend(Number(parts.blend.value)));
    parts.before.addEventListener("click", () => this.glide(0));
    parts.after.addEventListener("click", () => this.glide(1));
    parts.size.addEventListener("input", () => {
      this.isSizeChosen = true;
      this.viewer.setPointSize(Number(parts.size.value));
    });
    parts.up.addEventListener("change", () => this.viewer.setUp(parts.up.value));
    parts.fit.addEventListener("click", () => this.viewer.fit());
    parts.canvas.addEventListener("keydown", (event) => {
      if (event.key.toLowerCase() === "b" && !event.ctrlKey && !event.metaKey) this.glide(parts.blend.value >= 0.5 ? 0 : 1);
    });
    this.viewer.setPointSize(Number(parts.size.value));
    this.viewer.setUp(parts.up.value);
    this.show(null);
  }

  // Show a cloud (null: none) and a note below it.
  show(cloud, note = "") {
    this.cloud = cloud;
    if (cloud && this.viewer && !this.isSizeChosen) {
      const { clientWidth, clientHeight } = this.parts.stage;
      // As large as makes the points cover a part of the stage, so that a surface looks like one.
      const size = Math.sqrt((COVERED * clientWidth * clientHeight) / cloud.shown);
      this.parts.size.value = Math.min(Math.max(size, SMALLEST), LARGEST);
      this.viewer.setPointSize(Number(this.parts.size.value));
    }
    if (this.viewer) {
      this.viewer.show(cloud);
      cancelAnimationFrame(this.gliding);
      this.blend(1); // who looked at the last cloud's "before" waits for this one's "after"
    }
    this.note(note);
    this.update();
  }

  // The cloud has got points, or is complete.
  refresh({ isWhole }) {
    this.viewer?.refresh({ isWhole });
    this.update();
  }

  note(line) {
    this.parts.note.textContent = line;
  }

  update() {
    const { cloud, parts } = this;
    if (!this.viewer) return;
    const range = cloud && cloud.known > 0 ? cloud.range() : null;
    parts.empty.hidden = cloud !== null;
    parts.legend.hidden = range === null;
    const canBlend = Boolean(cloud?.hasBefore && cloud.known > 0);
    for (const name of ["blend", "before", "after"]) parts[name].disabled = !canBlend;
    parts.canvas.setAttribute("aria-label", cloud ? `Point cloud of ${text.plural(cloud.count, "point")}` : "Point cloud: none yet");
    if (!range) return;
    this.viewer.setRange(range.low, range.top);
    parts["legend-title"].textContent = cloud.hasBefore ? "moved, in the file’s unit" : "height z, in the file’s unit";
    const [low, top] = text.ends(range.low, range.top);
    parts["legend-low"].textContent = low;
    parts["legend-top"].textContent = cloud.hasBefore && range.top > range.low ? `${top} and more` : top;
  }

  blend(value) {
    this.parts.blend.value = value;
    this.parts.before.setAttribute("aria-pressed", value === 0);
    this.parts.after.setAttribute("aria-pressed", value === 1);
    this.parts.blend.setAttribute("aria-valuetext", `${Math.round(100 * value)} % of the way`);
    this.viewer.setBlend(value);
  }

  glide(target) {
    if (!this.cloud?.hasBefore) return;
    cancelAnimationFrame(this.gliding);
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.blend(target);
      return;
    }
    const begin = performance.now();
    const from = Number(this.parts.blend.value);
    const step = (now) => {
      const share = Math.min(Math.max((now - begin) / GLIDE_MS, 0), 1);
      this.blend(share === 1 ? target : from + (target - from) * share * share * (3 - 2 * share));
      if (share < 1) this.gliding = requestAnimationFrame(step);
    };
    this.gliding = requestAnimationFrame(step);
  }
}
