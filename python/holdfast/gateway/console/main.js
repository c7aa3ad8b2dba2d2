// The console: connects to a device, and switches between its views.

import { forgetToken, get, hasToken, notice, post, unmark } from "./api.js";
import { $, h, pause, say, tabs } from "./dom.js";
import * as pageUrl from "./page_url.js";
import { Discovery } from "./discovery.js";
import { FINAL, RESUME, Values } from "./values.js";

const gateway = { allowsWrites: null, refresh: loadGatewaySettings };
/** Errors of the probe after which other areas may still respond. */
const UNPROVEN = new Set(["timeout", "connection_lost", "invalid_reply", "exception"]);
const isSecure = () => $("transport").value === "tls";

/** The device that the form names. */
const target = () => ({
  host: $("host").value.trim(),
  port: Number($("port").value),
  unitId: Number($("unit").value),
  transport: $("transport").value,
  timeout: Number($("timeout").value),
  ...(isSecure() && $("server").value.trim() ? { serverName: $("server").value.trim() } : {}),
});

const choose = tabs(document.querySelector("[role=tablist]"));
const values = new Values(gateway);
const discovery = new Discovery((area, address, length) => {
  choose($("tab-values"));
  $("read").focus();
  values.open(area, address, length);
});

/** The connected device. The form may name another one meanwhile. */
let device = null;
let connecting = null;

/** Gets the settings of the gateway. */
async function loadGatewaySettings() {
  const status = await get("/api/gateway");
  gateway.allowsWrites = status.writes;
  values.permit();
  const mode = $("mode");
  mode.textContent = status.writes ? "reads and writes" : "reads only";
  mode.classList.toggle("writes", status.writes);
  mode.title = `May connect to ${status.allow.join(", ")}`;
  mode.hidden = false;
  $("timeout").max = status.limits.timeout;
  $("interval").min = status.limits.interval;
}

/** Gets the settings of the gateway, and connects if the page's URL has `watch=1` and names a device. */
async function begin() {
  let failed = null;
  try {
    await loadGatewaySettings();
  } catch (error) {
    failed = notice(error);
  }
  $("forget").hidden = !hasToken();
  // The limits of some fields are settings.
  const flaws = pageUrl.deviceFlaws();
  const isDamaged = flaws.length > 0;
  const isWatched = await values.recall(flaws);
  if (failed !== null || isDamaged) say($("connection"), failed, ...(isDamaged ? values.flaws : []));
  if (isWatched && !isDamaged && $("device").checkValidity()) connect(true);
}

/** Stores the device in the page's URL, so that it can be bookmarked and shared. */
function remember() {
  pageUrl.putDevice((id) => (id === "server" && !target().serverName ? null : $(id).value.trim()));
}

function fillDeviceForm() {
  pageUrl.fill(pageUrl.view().device);
  $("server-label").hidden = !isSecure();
}

/** Adapts the form to the transport. Keeps a port that is not a default port. */
function chooseTransport() {
  $("server-label").hidden = !isSecure();
  const [other, usual] = isSecure() ? ["502", "802"] : ["802", "502"];
  if ($("port").value === other) $("port").value = usual;
}

/** Connects. With `again`, it tries until the device responds: a page that was watching resumes, as a watch does. */
async function connect(again = false) {
  disconnect();
  remember();
  const asked = target();
  const aborting = new AbortController();
  connecting = aborting;
  say($("connection"), "Connecting…");
  let shownError = null;
  while (connecting === aborting) {
    try {
      await loadGatewaySettings();
      const began = performance.now();
      const found = await post("/api/modbus/connect", asked, { signal: aborting.signal });
      if (connecting !== aborting) return;
      const took = Math.round(performance.now() - began);
      if (found.exception) selectDevice(asked, `The device responded in ${took} ms, but can't read holding register 0: ${found.exception}. Other areas may work.`);
      else selectDevice(asked, `The device responded in ${took} ms.`);
    } catch (error) {
      if (connecting !== aborting) return;
      const retries = again && !FINAL.has(error.reason);
      if (!retries) connecting = null;
      if (error.message !== shownError) say($("connection"), notice(error), retries ? "Retrying…" : null, UNPROVEN.has(error.reason) ? offer(asked) : null);
      shownError = error.message;
      if (retries) await pause(RESUME);
    }
  }
}

/** Offers to continue with a device that did not respond. */
const offer = (asked) =>
  h("p", { class: "offer" }, "Only holding register 0 was read; other areas may respond. ",
    h("button", {
      type: "button",
      onclick: () => {
        selectDevice(asked, "Holding register 0 was not read, but other areas may work.", false);
        $("tab-values").focus();
      },
    }, "Continue anyway"));

/** Selects a device for the views. */
function selectDevice(asked, what, proven = true) {
  device = asked;
  connecting = null;
  say($("connection"), h("p", {}, h("span", { class: proven ? "dot" : "dot unproven" }), what));
  $("work").disabled = $("work").hidden = false;
  values.use(device);
  discovery.use(device);
  if (proven) identify();
}

/** Disconnects: nothing is read or written until the next connect. */
function disconnect() {
  connecting?.abort();
  connecting = device = null;
  $("work").disabled = true;
  $("identity").hidden = true;
  values.leave();
  discovery.leave();
}

/** Handles a change of the form: it may now name another device. */
function changed() {
  const was = device ?? connecting;
  disconnect();
  $("connection").querySelector(".offer")?.remove();
  const below = $("work").hidden ? "" : " The values below are stale.";
  if (was) say($("connection"), `Not connected: connect to continue.${below}`);
}

/** Shows the device identification. Many devices do not support it. */
async function identify() {
  const asked = device;
  const facts = await identification(asked).catch(() => []);
  if (asked !== device || facts.length === 0) return;
  $("identity").replaceChildren(...facts.map(([name, text]) => h("div", {}, h("dt", {}, name), h("dd", {}, text))));
  $("identity").hidden = false;
}

async function identification(asked) {
  const found = await post("/api/modbus/identify", asked);
  const names = {
    vendorName: "Vendor", productName: "Product", productCode: "Code", modelName: "Model",
    revision: "Revision", userApplicationName: "Application", vendorUrl: "Web",
  };
  return Object.entries(names).filter(([key]) => found[key]).map(([key, name]) => [name, found[key]]);
}

$("device").addEventListener("submit", (event) => {
  event.preventDefault();
  connect();
});
$("device").addEventListener("input", changed);
document.addEventListener("input", (event) => unmark(event.target));
$("transport").addEventListener("change", chooseTransport);
$("forget").addEventListener("click", () => {
  forgetToken();
  location.reload();
});

document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // The fragment of the page's URL is the link of the view.
  $("work").focus();
});
// Another link was opened in this tab. The page's own changes of its URL cause no such event.
addEventListener("hashchange", () => location.reload());

fillDeviceForm();
begin();
