// Streams of events from the gateway, and how many of them a browser may have.

import { answer, Problem, sendJson } from "./api.js";

/**
 * The most streams of this browser, by what they are for. It has six connections to a host: a watch leaves two for
 * everything else, a map one.
 */
export const MAX_STREAMS = { watch: 4, map: 5 };

/** How long a stream may be silent, in milliseconds. The gateway sends something every 5 s, or the connection is dead. */
const SILENCE = 20_000;

/** Asks for a stream, and calls `onEvent(name, data)` for each of its events, until it ends or is silent. */
export async function stream(path, body, options, onEvent) {
  const reply = await sendJson(path, body, options);
  if (!(reply.headers.get("Content-Type") ?? "").startsWith("text/event-stream")) {
    await answer(reply);
    throw new Problem("internal_error", "the gateway did not send an event stream");
  }
  const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
  let held = "";
  try {
    for (;;) {
      const alarm = setTimeout(() => reader.cancel(), SILENCE);
      const { value, done } = await reader.read().catch((error) => {
        if (error.name === "AbortError") throw error;
        throw new Problem("gateway_gone", "the connection to the gateway ended");
      }).finally(() => clearTimeout(alarm));
      if (done) return;
      const events = (held + value).split("\n\n");
      held = events.pop();
      for (const event of events) {
        if (event.startsWith(":")) continue;
        const match = /^event: ([^\n]*)\ndata: ([^\n]*)$/.exec(event);
        // The events after a lost one would be taken for something else.
        if (!match) throw new Problem("internal_error", "the gateway sent an event that can't be read");
        onEvent(match[1], JSON.parse(match[2]));
      }
    }
  } finally {
    // Also after an event that can't be read: the gateway counts open streams.
    reader.cancel().catch(() => {});
  }
}
