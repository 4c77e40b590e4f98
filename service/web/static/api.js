// Requests to the server this page came from, with the key if there is one, and its errors as one class.

import { keep, kept } from "./session.js";

const KEY = "straightpcf.key";

export class Problem extends Error {
  constructor({ status = 0, code = "connection_failed", detail, requestId = "", retryable = false }) {
    super(detail);
    Object.assign(this, { status, code, detail, requestId, retryable });
  }
}

export function apiKey() {
  return kept(KEY) ?? "";
}

export function keepApiKey(key) {
  keep(KEY, key || null);
}

export function url(path) {
  return new URL(path, document.baseURI).href;
}

export async function call(path, { method = "GET", headers = {}, ...more } = {}) {
  const sent = { ...authorization(), ...headers };
  let response;
  try {
    response = await fetch(url(path), { method, headers: sent, cache: "no-store", ...more });
  } catch (error) {
    if (more.signal?.aborted) throw error;
    throw unreachable();
  }
  if (!response.ok) throw problemFrom(response.status, await response.text(), response.headers.get("X-Request-Id"));
  return response;
}

export async function json(path, options) {
  const response = await call(path, options);
  return parsed(response.status, await response.text(), response.headers.get("X-Request-Id"));
}

// PUT a file as the body. XMLHttpRequest, because fetch does not tell how far an upload is.
export function upload(path, file, { onProgress, signal }) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("PUT", url(path));
    for (const [name, value] of Object.entries(authorization())) request.setRequestHeader(name, value);
    request.setRequestHeader("Content-Type", "application/octet-stream");
    request.upload.addEventListener("progress", (event) => onProgress(event.loaded / Math.max(event.total, 1)));
    request.addEventListener("load", () => {
      const answer = [request.status, request.responseText, request.getResponseHeader("X-Request-Id")];
      try {
        if (request.status >= 300) throw problemFrom(...answer);
        resolve(parsed(...answer));
      } catch (problem) {
        reject(problem); // what is thrown in a listener is lost
      }
    });
    request.addEventListener("error", async () => reject(await unsent(file)));
    request.addEventListener("abort", () => reject(new DOMException("canceled", "AbortError")));
    signal.addEventListener("abort", () => request.abort());
    request.send(file);
  });
}

export function pause(milliseconds, signal) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, milliseconds);
    signal?.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(new DOMException("canceled", "AbortError"));
    });
  });
}

function authorization() {
  const key = apiKey();
  if (!key) return {};
  if (/^[\x20-\x7e]*$/.test(key)) return { Authorization: `Bearer ${key}` };
  throw new Problem({ code: "unauthorized", detail: "The key holds more than printable ASCII, which no request can carry." });
}

function unreachable() {
  return new Problem({ detail: "The server does not answer. Is it running, and is the network there?", retryable: true });
}

// Why a file did not arrive: the browser does not tell one that it could not read from a server that is away.
async function unsent(file) {
  try {
    await file.slice(0, 1).arrayBuffer();
    return unreachable();
  } catch {
    return new Problem({ code: "", detail: `${file.name} has changed or is gone since it was chosen; choose it again.` });
  }
}

function parsed(status, text, requestId) {
  try {
    return JSON.parse(text);
  } catch {
    const detail = "The answer is not this server’s: a proxy before it may want you to log in. Reload the page.";
    throw new Problem({ status, code: "error", detail, requestId: requestId ?? "" });
  }
}

function problemFrom(status, text, requestId) {
  try {
    const problem = JSON.parse(text);
    const { detail, title, code = "error", request_id = requestId ?? "", retryable = false } = problem;
    return new Problem({ status, code, detail: detail ?? title ?? `The server answered ${status}.`, requestId: request_id, retryable });
  } catch {
    const retryable = status === 429 || status >= 502;
    const detail = status === 413 ? "A proxy before the server takes no file of this size." : `A proxy before the server answered ${status}.`;
    return new Problem({ status, code: "error", detail, requestId: requestId ?? "", retryable });
  }
}
