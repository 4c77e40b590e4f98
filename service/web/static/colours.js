// Viridis in 32 steps (matplotlib's, CC0): equal steps of value look equally far apart.

const VIRIDIS =
  "440154470d6048186a482374472e7c4538824241863e4a893a548c365d8d32658e2e6d8e2b758e287d8e25848e228c8d" +
  "1f948c1e9c8920a38625ab822eb37c3aba7648c16e58c7656ccd5a7fd34e93d741a8db34c0df25d5e21aeae51afde725";

// The part of the map that stands out from the stage behind it.
const PARTS = { dark: [0.3, 1], light: [0, 0.8] };
const STEPS = 64;

// Return (4 x 64) bytes RGBA for a theme, "dark" or "light".
export function palette(theme) {
  const [low, high] = PARTS[theme];
  const out = new Uint8Array(4 * STEPS);
  for (let step = 0; step < STEPS; step++) {
    const at = (low + ((high - low) * step) / (STEPS - 1)) * 31;
    const left = Math.min(Math.floor(at), 30);
    for (let channel = 0; channel < 3; channel++) {
      const [a, b] = [left, left + 1].map((item) => Number.parseInt(VIRIDIS.slice(6 * item + 2 * channel, 6 * item + 2 * channel + 2), 16));
      out[4 * step + channel] = Math.round(a + (b - a) * (at - left));
    }
    out[4 * step + 3] = 255;
  }
  return out;
}

export function drawPalette(canvas, theme) {
  const colours = palette(theme);
  const context = canvas.getContext("2d");
  for (let x = 0; x < canvas.width; x++) {
    const at = 4 * Math.floor((x / canvas.width) * STEPS);
    context.fillStyle = `rgb(${colours[at]} ${colours[at + 1]} ${colours[at + 2]})`;
    context.fillRect(x, 0, 1, canvas.height);
  }
}
