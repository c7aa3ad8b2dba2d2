// Writing: a new value, then what is there and what will be, side by side, then it is written.

import { post, Problem } from "./api.js";
import { $, h } from "./dom.js";
import { binary, bit, hex, modicon, numeral, register } from "./numbers.js";

const BITS_HELP = "0, 1, on or off. Several, with commas between them, go to the coils that follow.";
const HELP = {
  register: "Decimal, 0x… or 0b…. Several, with commas between them, go to the registers that follow.",
  text: "What is shorter is filled with zeros.",
  typed: "Several, with commas between them, go to the registers that follow.",
};
const MOST_REVIEWED = 16;

/** Asks for a value and writes it; resolves to true when something may have changed. */
export class Writer {
  constructor(target) {
    this.target = target;
    this.dialog = $("write-dialog");
    $("write-cancel").addEventListener("click", () => (this.change ? this.back() : this.dialog.close()));
    $("write-as").addEventListener("change", () => this.help());
    this.dialog.querySelector("form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.guarded(() => (this.change ? this.write() : this.review()));
    });
  }

  /** Opens the dialog for an address of a range. */
  ask(range, address) {
    this.range = range;
    this.address = address;
    const { host, port, unitId } = this.target();
    const what = range.ofBits ? "coil" : "holding register";
    $("write-title").textContent = `Write ${what} ${address}`;
    $("write-where").textContent = `${modicon(range.area, address)} of unit ${unitId} at ${host}:${port}`;
    const forms = range.ofBits ? ["bit"] : ["register", ...(range.type === "text" ? [] : [range.type])];
    $("write-as").replaceChildren(...forms.map((form) => h("option", { value: form }, form === "register" ? "register as it is" : form)));
    $("write-as-label").hidden = range.ofBits;
    const plain = ["int16", "uint16"].includes(range.type);
    if (!plain && (address - range.address) % range.width === 0) $("write-as").value = forms.at(-1);
    $("write-value").value = "";
    this.back();
    this.help();
    this.dialog.showModal();
    $("write-value").focus();
    return new Promise((resolve) => {
      this.written = false;
      this.dialog.addEventListener("close", () => resolve(this.written), { once: true });
    });
  }

  help() {
    const form = $("write-as").value;
    $("write-help").textContent = form === "bit" ? BITS_HELP : (HELP[form] ?? HELP.typed);
  }

  /** Back to the question. */
  back() {
    this.change = null;
    $("write-error").textContent = "";
    $("write-ask").hidden = false;
    $("write-review").hidden = true;
    $("write-go").textContent = "Review";
    $("write-cancel").textContent = "Cancel";
  }

  async guarded(step) {
    $("write-go").disabled = true;
    $("write-error").textContent = "";
    try {
      await step();
    } catch (error) {
      $("write-error").textContent = error.message;
    } finally {
      $("write-go").disabled = false;
    }
  }

  /** Reads what is there now, and shows it beside what was asked for. */
  async review() {
    const form = $("write-as").value;
    const parts = $("write-value").value.split(",");
    const typed = form !== "bit" && form !== "register";
    const wanted = typed ? parts.map((part) => numeral(part, form)) : parts.map(form === "bit" ? bit : register);
    const count = wanted.length * (typed ? this.range.width : 1);
    const now = await this.read(count, typed ? { datatype: form, byteOrder: this.range.order } : {});
    const before = typed ? now.typedText : now.values;
    this.change = { wanted, typed, form };
    const step = typed ? this.range.width : 1;
    $("write-review").replaceChildren(form === "register" && count === 1
      ? table("by-row", ["", "Decimal", "Hex", "Binary"], forms(before[0], wanted[0]))
      : table("by-column", ["", "Now", "New"], wanted.map((value, at) => [String(this.address + at * step), shown(before[at]), shown(value)])));
    $("write-review").hidden = false;
    $("write-ask").hidden = true;
    $("write-go").textContent = "Write it";
    $("write-cancel").textContent = "Back";
    $("write-go").focus();
  }

  async write() {
    const { wanted, typed, form } = this.change;
    const about = { ...this.target(), address: this.address };
    this.written = true;
    if (typed) {
      const more = JSON.stringify({ ...about, datatype: form, byteOrder: this.range.order });
      await post("/api/modbus/write/registers", `${more.slice(0, -1)},"values":[${wanted.join()}]}`);
    } else if (wanted.length === 1) {
      await post(form === "bit" ? "/api/modbus/write/coil" : "/api/modbus/write/register", { ...about, value: wanted[0] });
    } else {
      await post(form === "bit" ? "/api/modbus/write/coils" : "/api/modbus/write/registers", { ...about, values: wanted });
    }
    this.dialog.close();
  }

  async read(quantity, typed) {
    const { area, ofBits } = this.range;
    const most = ofBits ? 2000 : 125;
    if (quantity > most) throw new Problem("malformed", `${quantity} are too many, allowed are ${most}`);
    return post("/api/modbus/read", { ...this.target(), functionCode: area, address: this.address, quantity, ...typed });
  }
}

function shown(value) {
  if (typeof value === "boolean") return value ? "on" : "off";
  return typeof value === "number" ? `${value}  0x${hex(value)}` : value;
}

/** One register in every form; the bits that change are marked. */
function forms(before, after) {
  const [was, will] = [binary(before), binary(after)];
  const marked = [...will].map((bit, at) => (bit === was[at] ? bit : h("mark", {}, bit)));
  return [["Now", String(before), hex(before), was], ["New", String(after), hex(after), marked]];
}

function table(kind, head, rows) {
  const lines = rows.slice(0, MOST_REVIEWED).map(([name, ...cells]) =>
    h("tr", {}, h("th", { scope: "row" }, name), cells.map((cell) => h("td", {}, cell))));
  const more = rows.length - lines.length;
  return h("div", { class: "scroll" },
    h("table", { class: `review ${kind}` },
      h("thead", {}, h("tr", {}, head.map((text) => h("th", { scope: "col" }, text)))),
      h("tbody", {}, lines)),
    more > 0 ? h("p", { class: "dim" }, `and ${more} more`) : null);
}
