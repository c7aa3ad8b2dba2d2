// The table of the tags of a list.

import { h, quiet } from "./dom.js";
import { digits } from "./numbers.js";
import { Panel } from "./panel.js";
import { functionOf, placed } from "./parts.js";

/** Shows tags with their values and units. The cells of a list have the names of its tags. */
export class TagTable extends Panel {
  /** `actions` has `write(name)` and `plot(name)`. */
  constructor(part, tags, actions) {
    super(part);
    this.tags = tags;
    this.actions = actions;
    this.places = new Map(tags.map((tag, index) => [tag.name, index]));
    this.rows = [];
    this.fill(this.frame("values tags", ["Name", "Value", "Unit", "Place"], tags.map((tag) => this.row(tag))));
  }

  row(tag) {
    const value = h("td", { role: "cell", class: "typed" });
    this.rows.push(value);
    const button = (text, onclick, kind) => quiet(text, `${text} ${tag.name}`, onclick, kind);
    const { write, plot } = this.actions;
    const flaw = !tag.writable ? "writable is not true in the tag list" : typeof tag.scale !== "number" ? "its scale is in a register" : null;
    return h("tr", { role: "row", "data-tag": tag.name },
      h("th", { role: "rowheader", scope: "row", title: tag.description }, tag.name),
      value,
      h("td", { role: "cell", class: "unit" }, tag.unit),
      h("td", { role: "cell", class: "place" }, placed(tag)),
      h("td", { role: "cell", class: "do" },
        isPlotted(tag) ? button("Plot", () => plot(tag.name)) : null,
        flaw === null ? button("Write", () => write(tag.name), "write") : h("span", { class: "dim write", title: flaw }, "read only")));
  }

  render(index, mark) {
    const [cell, error] = [this.rows[index], this.errors.get(index)];
    const text = error ? "–" : this.texts[index];
    const before = cell.dataset.text;
    if (before === text && cell.dataset.error === (error ?? "")) return;
    cell.dataset.text = text;
    cell.dataset.error = error ?? "";
    cell.replaceChildren(text === "" ? "–" : text, ...(error ? [h("small", { class: "why" }, error)] : []));
    cell.title = error ?? text;
    if (mark && before !== undefined) this.mark(cell);
  }

  /** Returns the tag of a name, as long as the list has one. */
  tag(name) {
    return this.tags[this.places.get(name)];
  }

  number(name) {
    const value = this.values[this.places.get(name)];
    return typeof value === "number" || typeof value === "boolean" ? Number(value) : null;
  }

  /** Returns the value of a cell as text with its unit. */
  text(name) {
    const index = this.places.get(name);
    return [this.texts[index], this.tags[index].unit].filter(Boolean).join(" ");
  }

  /** Returns the number of a cell with all its digits. */
  digits(name) {
    return digits(this.number(name), this.texts[this.places.get(name)]);
  }

  cells() {
    return this.tags.filter(isPlotted).map((tag) => tag.name);
  }

  label(name) {
    return name;
  }

  /** Returns the cells that an index of values belongs to. */
  cellsOf(index) {
    return isPlotted(this.tags[index]) ? [this.tags[index].name] : [];
  }

  records() {
    return this.tags.map((tag, index) =>
      [tag.name, tag.area, tag.address, tag.type, tag.order, this.texts[index] ?? "", tag.unit, this.errors.get(index) ?? ""]);
  }

  /** Returns what the write dialog needs of a tag. */
  target(name) {
    const tag = this.tag(name);
    return { part: this.part, tag, area: functionOf(tag), address: tag.address, ofBits: tag.area === "coils" };
  }
}

const isPlotted = (tag) => !/^(string|bytes)|\[/.test(tag.type);
