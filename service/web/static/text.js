// Numbers as people read them.

const LOCALE = "en";
const MOST_DIGITS = 15; // what a double is good for

export function count(value) {
  return value.toLocaleString(LOCALE);
}

export function bytes(value) {
  const step = Math.min(Math.max(Math.floor(Math.log2(Math.max(value, 1)) / 10), 0), 4);
  const digits = step === 0 || value / 1024 ** step >= 100 ? 0 : 1;
  return `${trimmed((value / 1024 ** step).toFixed(digits))} ${["B", "KiB", "MiB", "GiB", "TiB"][step]}`;
}

// digits: those that count; before the point all are shown.
export function length(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "unknown";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-4) return value.toExponential(digits - 1);
  return value.toLocaleString(LOCALE, { maximumFractionDigits: Math.max(digits - 1 - Math.floor(Math.log10(size)), 0) });
}

// Two lengths with as many digits as tell them apart.
export function ends(low, top) {
  for (let digits = 3; ; digits++) {
    const texts = [length(low, digits), length(top, digits)];
    if (texts[0] !== texts[1] || low === top || digits === MOST_DIGITS) return texts;
  }
}

export function seconds(value) {
  if (value < 10) return `${value.toFixed(1)} s`;
  if (value < 120) return `${Math.round(value)} s`;
  return `${Math.round(value / 60)} min`;
}

export function plural(value, one, many = `${one}s`) {
  return `${count(value)} ${value === 1 ? one : many}`;
}

function trimmed(digits) {
  return digits.includes(".") ? digits.replace(/\.?0+$/, "") : digits;
}
