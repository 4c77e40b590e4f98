// A job's events: server-sent events over fetch, because EventSource cannot send a key.

import { call, json, pause } from "./api.js";

const SILENCE_MS = 45_000; // the server says something every 15 s
const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 8_000;
const HIDDEN_PAUSE_MS = 5_000;

// Call onEvent(kind, data) for every event, reconnecting where the last one ended; resolve to the finished job.
export async function watchJob(id, onEvent, signal) {
  let last = "";
  let wait = FIRST_PAUSE_MS;
  let isWaiting = false;
  for (;;) {
    try {
      if (isWaiting) await untilStartedOrSeen(id, signal);
      for await (const event of connection(id, last, signal, () => isWaiting)) {
        last = event.id || last;
        wait = FIRST_PAUSE_MS;
        const data = JSON.parse(event.data);
        onEvent(event.kind, data);
        if (event.kind === "completed") return data;
        isWaiting = event.kind === "queued";
        if (isWaiting && document.hidden) break;
      }
      if (isWaiting && document.hidden) continue;
    } catch (error) {
      if (signal.aborted) throw error;
      if (error.status && !error.retryable) throw error;
    }
    onEvent("reconnecting", {});
    await pause(wait, signal);
    wait = Math.min(2 * wait, LONGEST_PAUSE_MS);
  }
}

// While a job waits and its tab is not seen, ask now and then instead of holding a connection: over HTTP/1.1 a browser has
// six to a server, for all of its tabs together.
async function untilStartedOrSeen(id, signal) {
  while (document.hidden) {
    const { state } = await json(`jobs/${encodeURIComponent(id)}`, { signal });
    if (state !== "queued") return;
    const over = new AbortController();
    const seen = new Promise((resolve) => document.addEventListener("visibilitychange", resolve, { signal: over.signal }));
    try {
      await Promise.race([pause(HIDDEN_PAUSE_MS, signal), seen]);
    } finally {
      over.abort();
    }
  }
}

// Ends early where the tab is hidden and `mayLeave` says that nothing is missed.
async function* connection(id, last, signal, mayLeave) {
  const own = new AbortController();
  const end = () => own.abort();
  let isLeft = false;
  const leave = () => {
    isLeft = document.hidden && mayLeave();
    if (isLeft) end();
  };
  signal.addEventListener("abort", end);
  document.addEventListener("visibilitychange", leave);
  let silence = setTimeout(end, SILENCE_MS);
  try {
    const headers = { Accept: "text/event-stream", ...(last ? { "Last-Event-ID": last } : {}) };
    const response = await call(`jobs/${encodeURIComponent(id)}/events`, { headers, signal: own.signal });
    const reader = response.body.getReader();
    const parser = new EventParser();
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      clearTimeout(silence);
      silence = setTimeout(end, SILENCE_MS);
      yield* parser.feed(value);
    }
  } catch (error) {
    if (!isLeft) throw error;
  } finally {
    clearTimeout(silence);
    document.removeEventListener("visibilitychange", leave);
    signal.removeEventListener("abort", end);
    own.abort();
  }
}

// Turns bytes into {id, kind, data}, whatever the chunks are.
export class EventParser {
  constructor() {
    this.decoder = new TextDecoder();
    this.rest = "";
    this.clear();
  }

  feed(bytes) {
    this.rest += this.decoder.decode(bytes, { stream: true });
    // A carriage return at the end may be half of a line's end.
    const lines = this.rest.split(/\r\n|\n|\r(?!$)/);
    this.rest = lines.pop();
    const events = [];
    for (const line of lines) {
      if (line === "") {
        if (this.data.length) events.push({ id: this.id, kind: this.kind, data: this.data.join("\n") });
        this.clear();
      } else {
        this.field(line);
      }
    }
    return events;
  }

  field(line) {
    const [, name, value] = /^([^:]*):? ?(.*)$/.exec(line);
    if (name === "id") this.id = value;
    else if (name === "event") this.kind = value;
    else if (name === "data") this.data.push(value);
  }

  clear() {
    this.id = "";
    this.kind = "message";
    this.data = [];
  }
}
