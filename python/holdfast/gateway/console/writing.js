// The write dialog: asks for a value, shows it beside the current one, then writes it.

import { notice, post, Problem, stream } from "./api.js";
import { $, h, once } from "./dom.js";
import { binary, bit, hex, literal, modicon, register, separated } from "./numbers.js";
import { placed, same } from "./parts.js";
import { areaOf } from "./standard.js";

const BITS_HELP = "0, 1, on or off. Separate values for consecutive coils with semicolons.";
const HELP = {
  register: () => "Decimal, 0x… or 0b…. Separate values for consecutive registers with semicolons.",
  string: ({ size }) => `Up to ${size} ASCII characters. Shorter text is padded with zeros.`,
  bytes: ({ size }) => `${size} bytes in hex, such as 0a ff. Separate values for consecutive registers with semicolons.`,
  bit: () => "0, 1, on or off. This uses function 22. If the device does not support it, write the whole register.",
};
const TYPED_HELP = () => "With a decimal point, as in 21.5. Separate values for consecutive registers with semicolons.";
const MAX_REVIEWED = 16;

/** Reasons of errors that occur before anything is sent to the device. */
const UNSENT = new Set(["no_connection", "no_such_name", "refused_target", "writes_off", "malformed", "busy", "unauthorized",
  "foreign_page", "too_large", "not_json"]);
/** Exceptions after which a write may still be carried out: Acknowledge, and a gateway's timeout. */
const OPEN = /\(code 0x[5b]\)/;
/** The gateway's message for a timeout of a request that it has not sent. */
const KEPT = /was not sent/;

/** The write dialog. */
export class Writer {
  constructor() {
    this.asked = null;
    this.dialog = $("write-dialog");
    const form = this.dialog.querySelector("form");
    $("write-cancel").addEventListener("click", () => {
      if (this.asked.sending) return;
      if (this.asked.change) this.back();
      else this.dialog.close();
    });
    $("write-as").addEventListener("change", () => this.help());
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.step(this.asked);
    });
    form.addEventListener("keydown", (event) => {
      // A held Enter key must not confirm the next step.
      if (event.key === "Enter" && event.repeat) event.preventDefault();
    });
  }

  /**
   * Opens the dialog for an address of a range or a tag. Resolves to `written`, `refused` or
   * `unknown`, or to null when nothing was sent.
   */
  ask(target) {
    const { part, tag, area, address, ofBits } = target;
    const asked = { ...target, device: part.device, change: null, sending: null, outcome: null };
    this.asked = asked;
    const { host, port, unitId } = part.device;
    const what = ofBits ? "coil" : "holding register";
    $("write-title").textContent = tag ? `Write ${tag.name}` : `Write ${what} ${address}`;
    $("write-where").textContent = `${tag ? placed(tag) : modicon(area, address)} of unit ${unitId} at ${host}:${port}`;
    const forms = tag ? [["tag", "tag"]] : ofBits ? [["bit", "bit"]] : [["register", "plain register"], ["typed", part.type.name]];
    $("write-as").replaceChildren(...forms.map(([value, text]) => h("option", { value }, text)));
    $("write-as-label").hidden = ofBits || tag !== null;
    const plain = !tag && ["int16", "uint16"].includes(part.type.kind);
    if (!tag && !plain && (address - part.address) % part.width === 0) $("write-as").value = forms.at(-1)[0];
    const states = Object.values(tag?.states ?? {});
    $("write-states").replaceChildren(...states.map((value) => h("option", { value })));
    if (states.length > 0) $("write-value").setAttribute("list", "write-states");
    else $("write-value").removeAttribute("list");
    $("write-value").value = "";
    $("write-error").replaceChildren();
    this.back();
    this.help();
    this.dialog.showModal();
    $("write-value").focus();
    return new Promise((resolve) => {
      this.dialog.addEventListener("close", async () => {
        await asked.sending;
        resolve(asked.outcome);
      }, { once: true });
    });
  }

  help() {
    const { part, tag, ofBits } = this.asked;
    const typed = $("write-as").value === "typed";
    const kind = typed ? part.type.kind : "register";
    $("write-help").textContent = tag ? tagHelp(tag) : ofBits ? BITS_HELP : (HELP[kind] ?? TYPED_HELP)(part.type);
    $("write-value").required = !(typed && kind === "string") && !/^string/.test(tag?.type ?? "");
  }

  /** Returns to the first step. */
  back() {
    this.asked.change = null;
    $("write-ask").hidden = false;
    $("write-review").hidden = true;
    $("write-go").textContent = "Review";
    $("write-cancel").textContent = "Cancel";
  }

  /** Returns whether the dialog is open for this write. */
  isAbout(asked) {
    return this.asked === asked && this.dialog.open;
  }

  /** Says what the dialog waits for. Until then, its button does nothing. */
  wait(text) {
    $("write-wait").textContent = text;
  }

  step(asked) {
    return once($("write-go"), async () => {
      $("write-error").replaceChildren();
      this.wait(asked.change ? "Writing…" : "Reading the current value…");
      try {
        if (!asked.change) {
          await this.review(asked);
          return;
        }
        asked.sending = this.write(asked);
        await asked.sending;
      } catch (error) {
        if (this.isAbout(asked)) $("write-error").replaceChildren(error instanceof Problem ? notice(error) : error.message);
      } finally {
        asked.sending = null;
        if (this.asked === asked) this.wait("");
      }
    });
  }

  /** Reads the current values, and shows them beside the new ones. */
  async review(asked) {
    const change = asked.tag
      ? await ofTag(asked, $("write-value").value)
      : wanted(asked.part, $("write-as").value, $("write-value").value);
    change.before = await this.read(asked, change);
    if (!this.isAbout(asked)) return;
    asked.change = change;
    const { form, step, shown, before } = change;
    $("write-review").replaceChildren(form === "register" && shown.length === 1
      ? table("by-row", [h("span", { class: "unseen" }, "When"), "Decimal", "Hex", "Binary"], forms(before[0], shown[0]))
      : table("by-column", [asked.tag ? "Tag" : "Address", "Now", "New"], shown.map((value, at) => [asked.tag ? asked.tag.name : String(asked.address + at * step), inWords(before[at]), inWords(value)])));
    $("write-review").hidden = false;
    $("write-ask").hidden = true;
    $("write-go").textContent = "Write it";
    $("write-cancel").textContent = "Back";
    $("write-go").focus();
  }

  /** Writes the confirmed values. Never throws: `asked.outcome` has the outcome. */
  async write(asked) {
    const doubt = asked.outcome === "unknown" ? "unknown" : "refused";
    asked.outcome = "unknown";
    try {
      await post(...request(asked));
      asked.outcome = "written";
      if (this.isAbout(asked)) this.dialog.close();
    } catch (error) {
      const refused = error.reason === "exception"
        ? !OPEN.test(error.message)
        : UNSENT.has(error.reason) || KEPT.test(error.message);
      if (refused) asked.outcome = doubt;
      const told = refused ? "Not written." : "Unknown whether it was written.";
      const back = await this.read(asked, asked.change).catch(() => null);
      if (!this.isAbout(asked)) return;
      $("write-error").replaceChildren(notice(error, told), h("p", {}, compared(asked.change, back)));
      this.back();
    }
  }

  /** Reads the addresses of a change. */
  async read({ device, part, tag, area, address }, { count, typed }) {
    if (tag) return readTag(part, tag);
    const { most } = areaOf(area);
    if (count > most) throw new Error(`too many values: ${count}, at most ${most}`);
    const found = await post("/api/modbus/read", { ...device, functionCode: area, address, quantity: count, ...typed });
    return found.typedText ?? found.values;
  }
}

function tagHelp({ unit, min, max, states, type }) {
  const names = Object.values(states);
  const limits = [min === null ? "" : `from ${min}`, max === null ? "" : `to ${max}`].filter(Boolean).join(" ");
  return [
    names.length > 0 ? `One of ${names.join(", ")}.` : type === "bool" || type.startsWith("bit") ? "0, 1, on or off." : "A number, with a decimal point.",
    unit ? `In ${unit}.` : "",
    limits ? `Allowed: ${limits}.` : "",
  ].filter(Boolean).join(" ");
}

/** Reads the value of one tag as text. */
async function readTag(part, tag) {
  const body = JSON.stringify({ ...part.device, parts: [{ ...part.source, only: [tag.name] }], once: true, describe: false });
  let own = null;
  await stream("/api/modbus/watch/view", { method: "POST", body, extraTime: part.device.timeout }, (_, data) => ([own] = data.parts));
  const error = own?.error ?? own?.errors?.[0];
  if (own === null || error) throw new Problem(own?.reason ?? "exception", error ?? "the gateway sent no value");
  return own.texts;
}

/** Lets the gateway check the value of a tag, which is scaled there. */
async function ofTag({ part, tag }, text) {
  try {
    const { tag: now, form, values, text: shown } = await post("/api/gateway/tags/value", { ...part.source, name: tag.name, value: text });
    if (!same(now, tag)) throw new Error(`The gateway has another definition of ${tag.name} now. Close this dialog and read the values again.`);
    return { form, shown: [shown], json: values, step: 1, count: tag.count, typed: {} };
  } catch (error) {
    throw error.reason === "malformed" ? new Error(error.message) : error;
  }
}

/** Parses the typed values. Returns their display text and JSON. Throws an error if they are invalid. */
function wanted(range, form, text) {
  const { type, order } = range;
  if (form !== "typed") {
    // Bits have no decimals, so a comma between them separates.
    const shown = form === "bit" ? text.split(/[;,]/).map(bit) : separated(text).map(register);
    return { form, shown, json: shown, step: 1, count: shown.length, typed: {} };
  }
  const parts = type.kind === "string" ? [text] : type.kind === "bytes" ? text.split(/[;,]/) : separated(text);
  if (type.kind === "bit" && parts.length > 1) throw new Error("Write one bit at a time");
  const values = parts.map((part) => literal(part, type));
  return {
    form,
    shown: values.map((each) => each.shown),
    json: values.map((each) => each.json),
    step: type.width,
    count: values.length * type.width,
    typed: { datatype: type.name, byteOrder: order },
  };
}

/** Returns the path and the body of the request for a change. */
function request({ device, part: range, address, change }) {
  const about = { ...device, address };
  const { form, json, typed } = change;
  if (form === "mask") return ["/api/modbus/write/mask", { ...about, andMask: json[0], orMask: json[1] }];
  if (form === "typed" && range.type.kind === "bit") {
    const swapped = ["BADC", "DCBA"].includes(range.order) ? 8 : 0;
    const mask = 1 << (range.type.size ^ swapped);
    return ["/api/modbus/write/mask", { ...about, andMask: 65535 ^ mask, orMask: json[0] === "true" ? mask : 0 }];
  }
  if (form === "typed") {
    const more = JSON.stringify({ ...about, ...typed });
    return ["/api/modbus/write/registers", `${more.slice(0, -1)},"values":[${json.join()}]}`];
  }
  const [one, many] = form === "bit" || form === "coils" ? ["coil", "coils"] : ["register", "registers"];
  return json.length === 1
    ? [`/api/modbus/write/${one}`, { ...about, value: json[0] }]
    : [`/api/modbus/write/${many}`, { ...about, values: json }];
}

/** Describes the values that were read back after a failed write. */
function compared({ shown, before }, back) {
  if (back === null) return "Reading back failed: read the values before you continue.";
  const equals = (others) => back.every((value, at) => value === others[at]);
  if (equals(before)) return "Read back: unchanged.";
  if (equals(shown)) return "Read back: the new values are there.";
  return `Read back: neither the old nor the new values, but ${back.slice(0, MAX_REVIEWED).map(inWords).join(", ")}.`;
}

function inWords(value) {
  if (typeof value === "boolean") return value ? "on" : "off";
  return typeof value === "number" ? `${value}  0x${hex(value)}` : value;
}

/** Formats one register in every form. Changed bits are marked. */
function forms(before, after) {
  const [was, will] = [binary(before), binary(after)];
  const marked = [...will].map((bit, at) => (bit === was[at] ? bit : h("mark", {}, bit)));
  return [["Now", String(before), hex(before), was], ["New", String(after), hex(after), marked]];
}

function table(kind, head, rows) {
  const lines = rows.slice(0, MAX_REVIEWED).map(([name, ...cells]) =>
    h("tr", {}, h("th", { scope: "row" }, name), cells.map((cell) => h("td", {}, cell))));
  const more = rows.length - lines.length;
  return h("div", { class: "scroll" },
    h("table", { class: `review ${kind}` },
      h("thead", {}, h("tr", {}, head.map((text) => h("th", { scope: "col" }, text)))),
      h("tbody", {}, lines)),
    more > 0 ? h("p", { class: "dim" }, `and ${more} more`) : null);
}
