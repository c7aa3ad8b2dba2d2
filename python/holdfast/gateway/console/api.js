// Requests to the gateway. A token is kept only in the session storage of this tab.

import { $, h } from "./dom.js";

const KEY = "holdfast-token";
/** Tokens that a header can have. With another one, the browser sends nothing and reports no reason. */
const SENDABLE = /^[\x21-\x7e]+$/;
/** How long the gateway may need beyond the timeouts of the device, in milliseconds. */
const GRACE = 10_000;

/** An error: a reason as a word, the gateway's message, and the code of a Modbus exception. */
export class Problem extends Error {
  constructor(reason, said, code = null) {
    super(said);
    this.reason = reason;
    this.code = code;
    /** Whether a write may have been carried out; `null` if the gateway has not said it. */
    this.maybeWritten = null;
  }
}

export const hasToken = () => sessionStorage.getItem(KEY) !== null;
export const forgetToken = () => sessionStorage.removeItem(KEY);

/** Sends a GET request and returns the answer. */
export const get = async (path) => answer(await send(path));

/** Sends a POST request and returns the answer; `body` is an object, or JSON text without a timeout. */
export const post = async (path, body, { signal, headers } = {}) =>
  answer(await sendJson(path, body, { signal, headers, extraTime: body.timeout }));

/**
 * Returns the header of one write. With it, the gateway writes once, also when the browser sends the request again by
 * itself: it does so when the connection that it has reused ends without a response.
 */
export async function keyHeader() {
  const { keyPrefix } = await get("/api/gateway");
  return { "Idempotency-Key": keyPrefix + crypto.getRandomValues(new Uint32Array(4)).join("-") };
}

/** Sends a POST request; `body` is an object or JSON text. For the options, see `send`. */
export function sendJson(path, body, { headers, ...options }) {
  const text = typeof body === "string" ? body : JSON.stringify(body);
  return send(path, { method: "POST", headers: { "Content-Type": "application/json", ...headers }, body: text, ...options });
}

/** Sends a request, and waits for `extraTime` beyond the usual time for the answer to begin. */
async function send(path, { extraTime = 0, signal, ...options } = {}) {
  for (;;) {
    const token = sessionStorage.getItem(KEY);
    if (token !== null && !SENDABLE.test(token)) {
      await askForToken("A token has only visible ASCII characters. This one has another character, maybe an invisible one.");
      continue;
    }
    const headers = { ...options.headers, ...(token ? { Authorization: `Bearer ${token}` } : {}) };
    const ending = new AbortController();
    const end = () => ending.abort();
    signal?.addEventListener("abort", end);
    if (signal?.aborted) end();
    const alarm = setTimeout(end, extraTime + GRACE);
    let reply;
    try {
      reply = await fetch(path, { ...options, headers, cache: "no-store", signal: ending.signal });
    } catch (error) {
      if (signal?.aborted) throw error;
      if (error.name === "AbortError") throw new Problem("gateway_gone", `no answer within ${(extraTime + GRACE) / 1000} s; other tabs may use all connections of the browser`);
      throw new Problem("gateway_gone", "the gateway does not answer");
    } finally {
      clearTimeout(alarm);
    }
    if (reply.status !== 401) return reply;
    await askForToken(token === null ? "" : "Unknown token.");
  }
}

export async function answer(reply) {
  let body;
  try {
    body = await reply.json();
  } catch {
    throw new Problem("internal_error", `status ${reply.status}, the body is not JSON`);
  }
  if (reply.status === 200 && body.success !== false) return body;
  const said = reply.headers;
  const code = said.has("Holdfast-Exception") ? Number(said.get("Holdfast-Exception")) : null;
  const reason = said.get("Holdfast-Reason") ?? (code === null ? "internal_error" : "exception");
  const problem = new Problem(reason, body.error ?? `status ${reply.status}`, code);
  if (said.has("Holdfast-Maybe-Written")) problem.maybeWritten = said.get("Holdfast-Maybe-Written") === "true";
  throw problem;
}

let asking = null;

/** Asks for a token. Concurrent requests share one dialog. */
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

/** Creates a notice for an error: what it means, what to try, and the original message. */
export function notice(error, heading = null) {
  const [title, tries] = explained(error);
  return h("div", { class: "notice bad" },
    heading === null ? null : h("strong", {}, heading),
    heading === null ? h("strong", {}, title) : h("p", {}, title),
    tries.length > 0 ? h("ul", {}, tries.map((each) => h("li", {}, each))) : null,
    h("span", { class: "said" }, error.message));
}

/** Maps the gateway's field names to names on this page, where they differ. */
const FIELDS = {
  unitid: "unit", servername: "server", datatype: "type", byteorder: "order", values: "write-value", value: "write-value",
};

/** Marks the field whose name starts the error message. Returns whether it is on the page. */
function mark(error) {
  const name = /^\w+/.exec(error.message)?.[0].toLowerCase() ?? "";
  const known = FIELDS[name] ?? name;
  const field = [...document.querySelectorAll("input, select")]
    .find((each) => (each.id || each.name) === known && each.checkVisibility());
  field?.setAttribute("aria-invalid", "true");
  return field !== undefined;
}

/** Removes the mark from a field. */
export const unmark = (field) => field.removeAttribute("aria-invalid");

const WORDS = {
  timeout: ["The device did not respond in time.", [
    "Is the device powered and on this network? Is the address right?",
    "Is the unit id right? Many devices, and all serial devices behind a gateway, ignore other unit ids. Try 1, 0 or 255.",
    "Does a firewall drop the packets? Does another client use the device's only connection?",
    "Is the device slow? Try a longer timeout.",
  ]],
  no_connection: ["The connection was refused or failed.", [
    "Is Modbus TCP enabled in the device? Does it use a port other than 502?",
    "Is the address right? This may be another machine.",
  ]],
  connection_lost: ["The device closed the connection.", [
    "The device may allow few connections: is another client connected?",
    "Another protocol may run on this port: check port and transport.",
  ]],
  tls_failed: ["The TLS handshake failed.", [
    "Is the certificate for another name? If it is the right device, enter that name as the name in its certificate.",
    "Is the issuer unknown? The gateway trusts the certificates in --device-ca, or in device_tls in its configuration.",
    "Does the device require a certificate, or refuse the gateway's? Set --device-cert and --device-key, or device_tls in the configuration.",
    "Is this the TLS port? It is usually 802.",
  ]],
  invalid_reply: ["The response is not valid Modbus.", [
    "Is the transport right? A serial gateway may need RTU over TCP.",
    "Is the port right?",
  ]],
  no_such_name: ["The name can't be resolved.", ["Is it spelled right?", "Try the IP address instead."]],
  refused_target: ["The gateway does not allow this target.", [
    "Networks and ports are allowed with --allow, or with allow in the gateway's configuration.",
    "Is the port in that list too? The default is 502, and 802 with TLS.",
  ]],
  writes_off: ["Writes are disabled.", ["Enable them with --access read-write, or with access: read-write in the gateway's configuration."]],
  unauthorized: ["This gateway requires a token.", ["Create one with `holdfast token --line` for the token file, or with `holdfast token --gateway` for the configuration."]],
  busy: ["The gateway is busy.", ["Try again in a moment."]],
  repeated: ["The browser or a proxy sent the write again. The gateway did not write again.", ["Did a proxy or the gateway restart?"]],
  stopping: ["The gateway is stopping.", ["Reload the page when it runs again."]],
  gateway_gone: ["The gateway does not answer.", ["Is it still running?", "Reload the page when it runs again."]],
};

const EXCEPTIONS = {
  1: ["The device does not support this function.", ["It may not have this area: try another."]],
  2: ["The device does not have this address.", [
    "The manual may count from 1, or use numbers such as 40001: this page counts from 0.",
    "A range must not contain a missing address: read fewer addresses, or use the map.",
  ]],
  3: ["The device does not accept this value or quantity.", ["Read fewer addresses at once.", "Is the value in the range that the device allows?"]],
  4: ["The device failed to carry out the request.", ["Its current state may not allow it: check the device."]],
  5: ["The device accepted the request and is still processing it.", ["Try again later."]],
  6: ["The device is busy.", ["Try again in a moment."]],
  10: ["The Modbus gateway has no path to the device.", ["Is the unit id right?", "Is the serial line of that gateway configured?"]],
  11: ["The device behind the Modbus gateway does not respond.", ["Is the unit id right?", "Is the device powered, and the serial line wired?"]],
};

/** Returns what an error means, in one sentence. */
export const meaning = (error) => explained(error)[0];

function explained(error) {
  if (EXCEPTIONS[error.code]) return EXCEPTIONS[error.code];
  if (error.reason === "malformed") return ["The request is malformed.", [mark(error) ? "Check the marked value." : "Check the values."]];
  return WORDS[error.reason] ?? ["The request failed.", []];
}
