// What the tables of ranges and of tag lists have in common: values, errors, age, and marks.

import { meaning } from "./api.js";
import { clock, h } from "./dom.js";
import { hostAndPort } from "./parts.js";

/** How long a value that has changed is marked, in milliseconds. */
const MARKED = 1500;

/** The values of one part of a view. `render(index, mark)` shows one of them. */
export class Panel {
  constructor(part) {
    this.part = part;
    this.values = [];
    this.texts = [];
    this.errors = new Map();
    this.isStale = true;
    this.time = null;
    this.where = `${hostAndPort(part.device)}, unit ${part.device.unitId}`;
    this.heading = h("h3", { hidden: part.kind === "range" }, part.title);
    this.age = h("p", { class: "age" });
    this.why = h("p", { class: "why", hidden: true });
    this.place = h("section", { class: "panel", "aria-label": part.title }, this.heading, this.age, this.why);
  }

  /** Adds the table. */
  fill(root) {
    this.root = root;
    this.place.append(root);
  }

  /**
   * Creates the table. Its last column has what can be done with a value. The roles keep it accessible where the style
   * sheet makes cards of its rows.
   */
  frame(kind, head, rows) {
    const heading = (content) => h("th", { role: "columnheader", scope: "col" }, content);
    return h("table", { role: "table", class: kind, "aria-label": this.part.title },
      h("thead", { role: "rowgroup" },
        h("tr", { role: "row" }, head.map(heading), heading(h("span", { class: "unseen" }, "Actions")))),
      h("tbody", { role: "rowgroup" }, rows));
  }

  /** Shows what is for writing, or hides it. */
  permit(writes) {
    for (const each of this.root.querySelectorAll(".write")) each.hidden = !writes;
  }

  /** Sets all values. With `mark`, changes are marked. */
  set({ values, texts, errors }, mark) {
    const all = (list) => list.map((each, index) => [index, each]);
    const gone = [...this.errors.keys()].map((index) => [index, errors[index] ?? null]);
    const there = Object.entries(errors).map(([index, error]) => [Number(index), error]);
    return this.change({ values: all(values), texts: all(texts), errors: [...gone, ...there] }, mark);
  }

  /** Takes pairs of index and value. Returns the cells of the values that changed. */
  change({ values = [], texts = [], errors = [] }, mark = true) {
    const changed = new Set();
    const take = (known, pairs, placeOf = (index) => index) => {
      for (const [index, value] of pairs) {
        if (known[index] !== value) changed.add(placeOf(index));
        known[index] = value;
      }
    };
    for (const [index, error] of errors) {
      const place = this.placeOf(index);
      if ((this.errors.get(index) ?? null) !== error) changed.add(place);
      if (error === null) this.errors.delete(index);
      else this.errors.set(index, error);
    }
    take(this.values, values);
    take(this.texts, texts, (index) => this.placeOf(index));
    for (const index of changed) this.render(index, mark);
    return [...changed].flatMap((index) => this.cellsOf(index));
  }

  /** Returns the index in `values` of an index in `texts`. */
  placeOf(index) {
    return index;
  }

  mark(cell) {
    cell.classList.add("changed");
    clearTimeout(cell.fading);
    cell.fading = setTimeout(() => cell.classList.remove("changed"), MARKED);
  }

  /** Marks the values as current, as of a time in milliseconds. Values that are read once grow old. */
  fresh(time, isOnce) {
    this.time = time;
    this.isStale = false;
    const at = isOnce ? `, read at ${clock(time)}` : "";
    this.aged(`Values of ${this.where}${at}.`, null);
  }

  /** Marks the values as stale, and shows what to do or why. */
  stale(what = "Connect to read or write.", error = null) {
    this.isStale = true;
    this.aged(`Stale values of ${this.where}. ${what}`, error);
  }

  aged(text, error) {
    this.root.classList.toggle("stale", this.isStale);
    this.age.classList.toggle("old", this.isStale);
    if (this.age.textContent !== text) this.age.textContent = text;
    this.why.hidden = error === null;
    if (error !== null) this.why.textContent = `${meaning(error)} (${error.message})`;
  }
}
