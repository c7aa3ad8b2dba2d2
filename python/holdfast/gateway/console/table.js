// The table of registers, or the grid of bits, with marks for changes.

import { notice, post } from "./api.js";
import { $, h, quiet, table } from "./dom.js";
import { binary, digits, hex, modicon } from "./numbers.js";
import { Panel } from "./panel.js";
import { AREAS, areaOf } from "./standard.js";

const NAMES = ["Coil", "Discrete input"];
const SHORT = ["coil", "di", "hr", "ir"];

/** Shows the values of a range. Its cells have the numbers of the addresses. */
export class Table extends Panel {
  /** `actions` has `write(address)`, or null if the area can't be written, and `plot(address)`. */
  constructor(part, actions) {
    super(part);
    this.actions = actions;
    this.shown = new Map();
    this.fill(part.ofBits ? this.bits() : this.registers());
  }

  placeOf(index) {
    return index * this.part.width;
  }

  render(at, mark) {
    const cells = this.shown.get(at);
    const value = this.values[at];
    if (value !== cells.value) {
      if (this.part.ofBits) this.renderBit(cells.bit, this.part.address + at, value);
      else this.renderRegister(cells, value);
      if (mark && cells.value !== undefined) this.mark(cells.bit ?? cells.decimal);
      cells.value = value;
    }
    if (cells.typed) this.renderTyped(cells.typed, at / this.part.width, mark);
  }

  renderBit(bit, address, value) {
    bit.textContent = value ? "1" : "0";
    bit.classList.toggle("on", value);
    // The name contains the visible text, so that it can be spoken to.
    bit.setAttribute("aria-label", `${NAMES[this.part.area - 1]} ${address}: ${value ? "1, on" : "0, off"}`);
  }

  renderRegister(cells, value) {
    cells.decimal.textContent = value;
    cells.hex.textContent = hex(value);
    cells.binary.textContent = binary(value);
    cells.decimal.classList.toggle("zero", value === 0);
  }

  renderTyped(typed, index, mark) {
    const text = this.texts[index] ?? "";
    if (typed.textContent !== text) {
      const before = typed.textContent;
      typed.textContent = text;
      if (mark && before !== "") this.mark(typed);
    }
    typed.title = this.errors.get(index) ?? text;
  }

  /** Returns the number to plot for an address: the typed value if one starts there. */
  number(address) {
    const value = this.values[address - this.part.address];
    const text = this.text(address);
    if (text === null) return value === undefined ? null : Number(value);
    const { kind } = this.part.type;
    if (kind === "bool" || kind === "bit") return Number(text === "true");
    const number = Number(text);
    return text === "" || !Number.isFinite(number) ? null : number;
  }

  /** Returns the text of the typed value that `number` returns; `null` for a register or a bit. */
  text(address) {
    const at = address - this.part.address;
    const { width, ofBits, type } = this.part;
    if (ofBits || at % width !== 0 || type.kind === "string" || type.kind === "bytes") return null;
    return this.texts[at / width] ?? "";
  }

  /** Returns the number of an address with all its digits. */
  digits(address) {
    return digits(this.number(address), this.text(address));
  }

  cells() {
    return Array.from({ length: this.part.quantity }, (_, at) => this.part.address + at);
  }

  label(address, isAlone) {
    return isAlone ? String(address) : `${SHORT[this.part.area - 1]} ${address}`;
  }

  /** Returns the cells that an index of values belongs to: the start of its typed value. */
  cellsOf(at) {
    return [this.part.address + at - (at % this.part.width)];
  }

  records() {
    const { area, address, quantity, type, order, ofBits, width } = this.part;
    const areas = Object.keys(AREAS);
    const rows = [];
    for (let at = 0; at < quantity; at += width) {
      const index = at / width;
      const value = ofBits ? this.number(address + at) : this.texts[index];
      rows.push(["", areas[area - 1], address + at, ofBits ? "bool" : type.name, ofBits ? "" : order, value ?? "", "", this.errors.get(index) ?? ""]);
    }
    return rows;
  }

  /** Returns what the write dialog needs of an address. */
  target(address) {
    const { area, ofBits } = this.part;
    return { part: this.part, tag: null, area, address, ofBits };
  }

  registers() {
    const head = ["Address", "Decimal", "Hex", "Binary", this.part.type.name];
    return this.frame("values", head, this.cells().map((address, at) => this.row(address, at)));
  }

  row(address, at) {
    const { width, type, area } = this.part;
    const cells = {
      decimal: h("td", { role: "cell" }),
      hex: h("td", { role: "cell" }),
      binary: h("td", { role: "cell", class: "binary" }),
    };
    if (at % width === 0) {
      cells.typed = h("td", { role: "cell", class: "typed", rowSpan: width, "data-type": type.name });
    }
    this.shown.set(at, cells);
    return h("tr", { role: "row", "data-address": address },
      h("th", { role: "rowheader", scope: "row" }, String(address), h("span", { class: "modicon" }, modicon(area, address))),
      cells.decimal, cells.hex, cells.binary, cells.typed, this.buttons(address, at));
  }

  buttons(address, at) {
    const button = (text, label, onclick, kind) => quiet(text, `${label} ${address}`, onclick, kind);
    const { write, plot } = this.actions;
    return h("td", { role: "cell", class: "do" },
      button("Types", "All types from", () => this.showTypes(at)),
      button("Plot", "Plot", () => plot(address)),
      write ? button("Write", "Write", () => write(address), "write") : null);
  }

  bits() {
    const field = h("div", { class: "bits", role: "group", "aria-label": this.part.title });
    const { address, quantity } = this.part;
    for (let start = 0; start < quantity; start += 16) {
      const run = h("div", { class: "run" });
      for (let at = start; at < Math.min(start + 16, quantity); at += 1) run.append(this.bit(at));
      field.append(h("span", { class: "from" }, String(address + start)), run);
    }
    return field;
  }

  bit(at) {
    const bit = h("button", { class: "bit", type: "button" });
    this.shown.set(at, { bit });
    return bit;
  }

  /** A click on a bit writes it. It is for a plot if it can't be written. */
  permit(writes) {
    super.permit(writes);
    if (!this.part.ofBits) return;
    const { write, plot } = this.actions;
    const [verb, act] = writes && write ? ["Write", write] : ["Plot", plot];
    for (const [at, { bit }] of this.shown) {
      const address = this.part.address + at;
      bit.title = `${verb} ${areaOf(this.part.area).title.toLowerCase()} ${address}`;
      bit.onclick = () => act(address);
    }
  }

  /** Shows up to four registers in every type and byte order. */
  async showTypes(at) {
    const registers = this.values.slice(at, at + 4);
    const title = `All types from ${this.part.address + at}: ${registers.map(hex).join(" ")}`;
    $("types-title").textContent = title;
    $("types-table").replaceChildren();
    $("types-dialog").showModal();
    const shown = await post("/api/gateway/types", { registers }).then(({ tables }) => tables.map(tableOf), (error) => [notice(error)]);
    // Another dialog may be open meanwhile.
    if ($("types-title").textContent === title) $("types-table").replaceChildren(...shown);
  }
}

/** Shows the texts of registers by type and byte order. */
const tableOf = ({ orders, rows }) => table("review", null, ["Type", ...orders], rows.map(({ type, texts }) => [type, ...texts]));
