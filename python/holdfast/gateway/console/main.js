// The console: which device, and what to do with it.

import { forgetToken, get, hasToken, notice, post } from "./api.js";
import { $, h, say, tabs } from "./dom.js";
import { Map_ } from "./mapping.js";
import { Values } from "./values.js";

const may = { write: false };
const fields = ["host", "port", "unit", "transport", "timeout"];

/** The device that the form names. */
const target = () => ({
  host: $("host").value.trim(),
  port: Number($("port").value),
  unitId: Number($("unit").value),
  transport: $("transport").value,
  timeout: Number($("timeout").value),
});

const choose = tabs(document.querySelector("[role=tablist]"));
const values = new Values(target, may);
new Map_(target, (area, address, quantity) => {
  choose($("tab-values"));
  values.open(area, address, quantity);
});

/** Asks the gateway what it may do. */
async function begin() {
  try {
    const status = await get("/api/gateway");
    may.write = status.writes;
    const mode = $("mode");
    mode.textContent = status.writes ? "reads and writes" : "reads only";
    mode.classList.toggle("writes", status.writes);
    mode.title = `May connect to ${status.allow.join(", ")}`;
    mode.hidden = false;
    $("timeout").max = status.limits.timeout;
    $("interval").min = status.limits.interval;
  } catch (error) {
    say($("connection"), notice(error));
  }
  $("forget").hidden = !hasToken();
}

/** The device is part of the address of the page, so that it can be kept and passed on. */
function remember() {
  const query = new URLSearchParams(fields.map((id) => [id, $(id).value.trim()]));
  history.replaceState(null, "", `#${query}`);
}

function recall() {
  for (const [id, value] of new URLSearchParams(location.hash.slice(1))) {
    if (fields.includes(id)) $(id).value = value;
  }
}

async function connect() {
  values.stop();
  remember();
  $("connect").disabled = true;
  $("identity").hidden = true;
  say($("connection"), "Connecting…");
  try {
    const began = performance.now();
    const found = await post("/api/modbus/connect", target());
    const took = Math.round(performance.now() - began);
    const what = found.exception
      ? `The device answers, in ${took} ms. Holding register 0 it refuses: ${found.exception}.`
      : `The device answers, in ${took} ms.`;
    say($("connection"), h("p", {}, h("span", { class: "dot" }), what));
    $("work").hidden = false;
    identify();
  } catch (error) {
    say($("connection"), notice(error));
  } finally {
    $("connect").disabled = false;
  }
}

/** What the device says of itself, if it does; many don't. */
async function identify() {
  const asked = JSON.stringify(target());
  const facts = await told().catch(() => []);
  if (asked !== JSON.stringify(target()) || facts.length === 0) return;
  $("identity").replaceChildren(...facts.map(([name, text]) => h("div", {}, h("dt", {}, name), h("dd", {}, text))));
  $("identity").hidden = false;
}

async function told() {
  const found = await post("/api/modbus/identify", target());
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
$("device").addEventListener("input", () => values.stop());
$("forget").addEventListener("click", () => {
  forgetToken();
  location.reload();
});

recall();
begin();
