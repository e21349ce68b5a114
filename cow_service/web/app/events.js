// The events of a job: a stream that goes on after the connection was lost.

import { Unreachable, call, persist } from "./server.js";

/** Reads server-sent events of a response: calls `each` with {event, id, data}. */
async function read(response, each) {
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    let chunk;
    try {
      chunk = await reader.read();
    } catch {
      throw new Unreachable();
    }
    if (chunk.done) return;
    const blocks = (rest + chunk.value).split(/\r?\n\r?\n/);
    rest = blocks.pop();
    for (const block of blocks) {
      const event = { event: "message", id: null, data: "" };
      for (const line of block.split(/\r?\n/)) {
        const [name, ...rest] = line.split(":"); // a value may hold any character but ends of lines
        if (name in event) event[name] = rest.join(":").replace(/^ /, "");
      }
      if (event.data) each(event);
    }
  }
}

const LAST = new Set(["succeeded", "failed", "canceled", "deleted"]);

/** Follows a job to its end. `onEvent` hears (name, job); `tell` hears whether the server is away. */
export async function follow(jobId, onEvent, tell, signal) {
  let last = null;
  let ended = false;
  while (!ended) {
    await persist(async () => {
      const headers = last === null ? {} : { "Last-Event-ID": last };
      const response = await call(`/jobs/${jobId}/events`, { headers, signal });
      tell(false);
      if (response.status === 204) {
        ended = true;
        return;
      }
      await read(response, ({ event, id, data }) => {
        last = id ?? last;
        ended = ended || LAST.has(event);
        onEvent(event, JSON.parse(data));
      });
      if (!ended) throw new Unreachable(); // the stream ended before the job
    }, tell, signal);
  }
}
