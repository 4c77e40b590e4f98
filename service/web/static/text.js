// Numbers as people read them.

const LOCALE = "en";

export function count(value) {
  return value.toLocaleString(LOCALE);
}

export function bytes(value) {
  const step = Math.min(Math.max(Math.floor(Math.log2(Math.max(value, 1)) / 10), 0), 4);
  const digits = step === 0 || value / 1024 ** step >= 100 ? 0 : 1;
  return `${trimmed((value / 1024 ** step).toFixed(digits))} ${["B", "KiB", "MiB", "GiB", "TiB"][step]}`;
}

export function length(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "unknown";
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-4 ? value.toExponential(2) : trimmed(value.toPrecision(3));
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
