// Requests to the gateway. A token, if one is needed, lives in this tab's session storage only.

import { $, h } from "./dom.js";

const KEY = "holdfast-token";
const JSON_TYPE = { "Content-Type": "application/json" };

/** What went wrong: a reason in a word, and what the gateway said. */
export class Problem extends Error {
  constructor(reason, said) {
    super(said);
    this.reason = reason;
  }
}

export const hasToken = () => sessionStorage.getItem(KEY) !== null;
export const forgetToken = () => sessionStorage.removeItem(KEY);

/** The answer to a GET. */
export const get = async (path) => answer(await send(path));

/** The answer to a POST; `body` may be JSON text already. */
export const post = async (path, body, signal) =>
  answer(await send(path, {
    method: "POST",
    headers: JSON_TYPE,
    body: typeof body === "string" ? body : JSON.stringify(body),
    signal,
  }));

/** Calls `onEvent(name, data)` for the events of an answer that goes on, until it ends. */
export async function stream(path, options, onEvent) {
  const headers = options.body ? JSON_TYPE : {};
  const reply = await send(path, { ...options, headers });
  if (!(reply.headers.get("Content-Type") ?? "").startsWith("text/event-stream")) {
    await answer(reply);
    throw new Problem("internal_error", "the gateway sent no events");
  }
  const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
  let held = "";
  for (;;) {
    const { value, done } = await reader.read().catch((error) => {
      if (error.name === "AbortError") throw error;
      throw new Problem("gateway_gone", "the connection to the gateway ended");
    });
    if (done) return;
    const events = (held + value).split("\n\n");
    held = events.pop();
    for (const event of events) {
      const match = /^event: (.*)\ndata: (.*)$/.exec(event);
      if (match) onEvent(match[1], JSON.parse(match[2]));
    }
  }
}

async function send(path, options = {}) {
  for (;;) {
    const token = sessionStorage.getItem(KEY);
    const headers = { ...options.headers, ...(token ? { Authorization: `Bearer ${token}` } : {}) };
    let reply;
    try {
      reply = await fetch(path, { ...options, headers, cache: "no-store" });
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw new Problem("gateway_gone", "the gateway does not answer");
    }
    if (reply.status !== 401) return reply;
    await askForToken(token === null ? "" : "The gateway does not know this token.");
  }
}

async function answer(reply) {
  let body;
  try {
    body = await reply.json();
  } catch {
    throw new Problem("internal_error", `status ${reply.status}, and no JSON`);
  }
  if (reply.status === 200 && body.success !== false) return body;
  throw new Problem(reply.headers.get("Holdfast-Reason") ?? "exception", body.error ?? `status ${reply.status}`);
}

let asking = null;

/** Asks once, however many requests wait for it. */
function askForToken(error) {
  asking ??= new Promise((resolve, reject) => {
    const dialog = $("token-dialog");
    $("token").value = "";
    $("token-error").textContent = error;
    dialog.addEventListener("close", () => {
      asking = null;
      const given = $("token").value.trim();
      $("token").value = "";
      if (dialog.returnValue === "cancel" || !given) {
        reject(new Problem("unauthorized", "no token was given"));
        return;
      }
      sessionStorage.setItem(KEY, given);
      $("forget").hidden = false;
      resolve();
    }, { once: true });
    dialog.returnValue = "cancel";
    dialog.showModal();
  });
  return asking;
}

/** A problem as a notice: what it means in plain words, what to try, what was said. */
export function notice(error, heading = null) {
  const [title, tries] = explained(error);
  return h("div", { class: "notice bad" },
    heading === null ? null : h("strong", {}, heading),
    heading === null ? h("strong", {}, title) : h("p", {}, title),
    tries.length > 0 ? h("ul", {}, tries.map((each) => h("li", {}, each))) : null,
    h("span", { class: "said" }, error.message));
}

/** Fields of the page by what the gateway calls them, where that is not their name. */
const FIELDS = {
  unitid: "unit", servername: "server", datatype: "type", byteorder: "order", values: "write-value", value: "write-value",
};

/** Marks the field that an error begins with; whether it is on the page. */
function mark(error) {
  const name = /^\w+/.exec(error.message)?.[0].toLowerCase() ?? "";
  const known = FIELDS[name] ?? name;
  const field = [...document.querySelectorAll("input, select")]
    .find((each) => (each.id || each.name) === known && each.checkVisibility());
  field?.setAttribute("aria-invalid", "true");
  return field !== undefined;
}

/** A field is no longer the one that was wrong. */
export const unmark = (field) => field.removeAttribute("aria-invalid");

const WORDS = {
  timeout: ["No answer in time.", [
    "Is the device powered and on this network? Is the address right?",
    "Is the unit id right? Many devices, and all serial ones behind a gateway, stay silent for others. Try 1, 0 or 255.",
    "Does a firewall drop the packets? Does another master hold the only connection?",
    "Is the device slow? Try a longer timeout.",
  ]],
  no_connection: ["There is something at this address, or on the way to it, but it takes no connection.", [
    "Is Modbus TCP switched on in the device? Is its port another than 502?",
    "Is the address right? This may be another machine.",
  ]],
  connection_lost: ["The device ended the connection.", [
    "It may allow few connections: is another master connected?",
    "It may speak something else on this port: check port and transport.",
  ]],
  tls_failed: ["TLS was not agreed on.", [
    "Is the certificate for another name? If that is the device, give it as the name in its certificate.",
    "Is its issuer unknown? Whoever runs the gateway says who is trusted: with --tls-ca, or tls in its configuration.",
    "Does the device ask for a certificate, or refuse the gateway's? That is --tls-cert and --tls-key, or tls in its configuration.",
    "Is this the port of TLS? It is 802 as a rule.",
  ]],
  invalid_reply: ["Something answers, but not as Modbus should.", [
    "Is the transport right? A serial gateway may want RTU over TCP.",
    "Is the port right?",
  ]],
  no_such_name: ["Nobody knows this name.", ["Is it spelled right?", "Try the IP address instead."]],
  refused_target: ["This gateway may not connect there.", [
    "Whoever runs the gateway says which networks and ports it may use: with --allow, or allow in its configuration.",
    "Is the port in that list too? Without ports it is 502, and 802 with TLS.",
  ]],
  writes_off: ["This gateway only reads.", ["Whoever runs it can allow writing: with --writes, or access: read-write in its configuration."]],
  unauthorized: ["This gateway needs a token.", ["`holdfast token --line` makes one for its token file, `holdfast token --gateway` one for its configuration."]],
  busy: ["The gateway has too much to do.", ["Try again in a moment."]],
  stopping: ["The gateway is being stopped.", ["Reload the page when it runs again."]],
  gateway_gone: ["The gateway does not answer.", ["Is it still running?", "Reload the page when it is."]],
};

const EXCEPTIONS = {
  "0x1": ["The device does not know this function.", ["It may not have this area: try another."]],
  "0x2": ["The device has no such address.", [
    "Its manual may count from 1, or write 40001: this page counts from 0.",
    "A range must not touch an address that is missing: read fewer, or find out with the map.",
  ]],
  "0x3": ["The device does not take this value or quantity.", ["Read fewer at once.", "Is the value in the range of the device?"]],
  "0x4": ["The device failed at this.", ["It may be in a state that does not allow it: look at the device."]],
  "0x5": ["The device works on it.", ["Try again in a while."]],
  "0x6": ["The device is busy.", ["Try again in a moment."]],
  "0xa": ["The gateway in front of the device has no way to it.", ["Is the unit id right?", "Is the serial line of that gateway set up?"]],
  "0xb": ["The device behind the gateway does not answer.", ["Is the unit id right?", "Is the device powered, and the serial line wired?"]],
};

function explained(error) {
  const code = /\(code (0x[0-9a-f]+)\)/.exec(error.message);
  if (code && EXCEPTIONS[code[1]]) return EXCEPTIONS[code[1]];
  if (error.reason === "malformed") return ["The gateway can't take this request.", [mark(error) ? "Check the marked value." : "Check the values."]];
  return WORDS[error.reason] ?? ["This did not work.", []];
}
