// A job's events: server-sent events over fetch, because EventSource cannot send a key.

import { call, pause } from "./api.js";

const SILENCE_MS = 45_000; // the server says something every 15 s
const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 8_000;

// Call onEvent(kind, data) for every event, reconnecting where the last one ended; resolve to the finished job.
export async function watchJob(id, onEvent, signal) {
  let last = "";
  let wait = FIRST_PAUSE_MS;
  for (;;) {
    try {
      for await (const event of connection(id, last, signal)) {
        last = event.id || last;
        wait = FIRST_PAUSE_MS;
        const data = JSON.parse(event.data);
        onEvent(event.kind, data);
        if (event.kind === "completed") return data;
      }
    } catch (error) {
      if (signal.aborted) throw error;
      if (error.status && !error.retryable) throw error;
    }
    onEvent("reconnecting", {});
    await pause(wait, signal);
    wait = Math.min(2 * wait, LONGEST_PAUSE_MS);
  }
}

async function* connection(id, last, signal) {
  const own = new AbortController();
  const end = () => own.abort();
  signal.addEventListener("abort", end);
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
  } finally {
    clearTimeout(silence);
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
