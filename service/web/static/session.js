// What this tab keeps through a reload; where the browser keeps nothing for a page (cookies are blocked), until then.

const held = new Map();

export function kept(name) {
  try {
    return sessionStorage.getItem(name);
  } catch {
    return held.get(name) ?? null;
  }
}

// value: text, or null to forget it.
export function keep(name, value) {
  try {
    if (value === null) sessionStorage.removeItem(name);
    else sessionStorage.setItem(name, value);
  } catch {
    held.set(name, value);
  }
}
