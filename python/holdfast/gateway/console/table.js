// The table of registers, or the grid of bits, with marks for changes.

import { $, h } from "./dom.js";
import { binary, everyType, hex, modicon } from "./numbers.js";

const MARKED = 1500;

/** Shows the values of a range and updates them. */
export class Table {
  /** `actions` has `write(address)`, or null if writes are not possible, and `plot(address)`. */
  constructor(place, range, actions) {
    this.range = range;
    this.values = [];
    this.texts = [];
    this.actions = actions;
    this.cells = new Map();
    const { host, port, unitId } = range.device;
    this.where = `${host}:${port}, unit ${unitId}`;
    this.age = h("p", { class: "age" });
    this.root = range.ofBits ? this.bits() : this.registers();
    place.replaceChildren(this.age, this.root);
    this.stale(false);
  }

  /** Sets all values, and the texts of typed values. With `mark`, changes are marked. */
  set(values, texts, mark = false) {
    values.forEach((value, at) => this.put(at, value, mark));
    (texts ?? []).forEach((text, index) => this.putTyped(index, text, mark));
    this.stale(false);
  }

  put(at, value, mark = true) {
    const before = this.values[at];
    this.values[at] = value;
    if (before === value) return;
    const cells = this.cells.get(at);
    if (this.range.ofBits) {
      cells.bit.textContent = value ? "1" : "0";
      cells.bit.classList.toggle("on", value);
      cells.bit.setAttribute("aria-label", `${this.range.address + at} is ${value ? "on" : "off"}`);
    } else {
      cells.decimal.textContent = value;
      cells.hex.textContent = hex(value);
      cells.binary.textContent = binary(value);
      cells.decimal.classList.toggle("zero", value === 0);
    }
    if (mark && before !== undefined) this.mark(cells.bit ?? cells.decimal);
  }

  putTyped(index, text, mark = true) {
    const before = this.texts[index];
    this.texts[index] = text;
    if (before === text) return;
    const { typed } = this.cells.get(index * this.range.width) ?? {};
    if (!typed) return;
    typed.textContent = text;
    typed.title = text;
    if (mark && before !== undefined) this.mark(typed);
  }

  mark(cell) {
    cell.classList.add("changed");
    clearTimeout(cell.fading);
    cell.fading = setTimeout(() => cell.classList.remove("changed"), MARKED);
  }

  /** Marks the values as stale or current. */
  stale(is) {
    this.root.classList.toggle("stale", is);
    this.age.classList.toggle("old", is);
    this.age.textContent = is ? `Stale values of ${this.where}.` : `Values of ${this.where}.`;
  }

  /** Returns the number to plot for an address: the typed value if one starts there. */
  number(at) {
    const { width, ofBits, type } = this.range;
    if (ofBits) return Number(this.values[at]);
    if (type.kind === "string" || type.kind === "bytes") return this.values[at];
    if (type.kind === "bool" || type.kind === "bit") return Number(this.texts[at] === "true");
    const text = at % width === 0 ? this.texts[at / width] : undefined;
    const number = Number(text);
    return text === undefined || text === "" || Number.isNaN(number) ? this.values[at] : number;
  }

  registers() {
    const { address, quantity, width, type, area } = this.range;
    const body = h("tbody", { role: "rowgroup" });
    for (let at = 0; at < quantity; at += 1) {
      const cells = {
        decimal: h("td", { role: "cell" }),
        hex: h("td", { role: "cell" }),
        binary: h("td", { role: "cell", class: "binary" }),
      };
      if (at % width === 0) {
        cells.typed = h("td", { role: "cell", class: "typed", rowSpan: width, "data-type": type.name });
      }
      this.cells.set(at, cells);
      body.append(h("tr", { role: "row", "data-address": address + at },
        h("th", { role: "rowheader", scope: "row" },
          String(address + at), h("span", { class: "modicon" }, modicon(area, address + at))),
        cells.decimal, cells.hex, cells.binary, cells.typed, this.buttons(at)));
    }
    const head = ["Address", "Decimal", "Hex", "Binary", type.name, ""].map((text) =>
      h("th", { role: "columnheader", scope: "col" }, text || h("span", { class: "unseen" }, "Actions")));
    return h("table", { role: "table", class: "values", "aria-label": this.range.title },
      h("thead", { role: "rowgroup" }, h("tr", { role: "row" }, head)), body);
  }

  buttons(at) {
    const address = this.range.address + at;
    const button = (text, label, onclick) =>
      h("button", { class: "quiet", type: "button", "aria-label": `${label} ${address}`, onclick }, text);
    const { write, plot } = this.actions;
    return h("td", { role: "cell", class: "do" },
      button("Types", "All types from", () => this.showTypes(at)),
      button("Plot", "Plot", () => plot(address)),
      write ? button("Write", "Write", () => write(address)) : null);
  }

  bits() {
    const field = h("div", { class: "bits", role: "group", "aria-label": this.range.title });
    const { address, quantity } = this.range;
    for (let start = 0; start < quantity; start += 16) {
      const run = h("div", { class: "run" });
      for (let at = start; at < Math.min(start + 16, quantity); at += 1) run.append(this.bit(at));
      field.append(h("span", { class: "from" }, String(address + start)), run);
    }
    return field;
  }

  bit(at) {
    const address = this.range.address + at;
    const act = this.actions.write ?? this.actions.plot;
    const bit = h("button", { class: "bit", type: "button", title: `${address}`, onclick: () => act(address) });
    this.cells.set(at, { bit });
    return bit;
  }

  /** Shows up to four registers in every type and byte order. */
  showTypes(at) {
    const own = this.values.slice(at, at + 4);
    $("types-title").textContent = `All types from ${this.range.address + at}: ${own.map(hex).join(" ")}`;
    $("types-table").replaceChildren(...everyType(own).map(([orders, rows]) => h("table", { class: "review" },
      h("thead", {}, h("tr", {}, ["Type", ...orders].map((each) => h("th", { scope: "col" }, each)))),
      h("tbody", {}, rows.map(([type, texts]) =>
        h("tr", {}, h("th", { scope: "row" }, type), texts.map((text) => h("td", {}, text))))))));
    $("types-dialog").showModal();
  }
}
