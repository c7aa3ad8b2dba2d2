// The map of a device: a picture of each area, and a list of its ranges.

import { notice, Problem } from "./api.js";
import { $, colour, h, onTheme, quiet, say } from "./dom.js";
import { AREAS } from "./standard.js";
import { MAX_STREAMS, stream } from "./streams.js";

const FAILURES = { timeout: "no response", connection: "connection lost", invalid: "invalid response" };
const CELLS = 1024;
const NARROW = 640;
const MAX_LISTED = 200;
const ZOOM = 8;
/** The fewest addresses that a picture shows. */
const MIN_SIZE = 64;
const LEGEND = { there: "valid", absent: "asked, absent", failed: "failed", unread: "not asked" };

/** The map view. `open` shows a range in the values view. */
export class Discovery {
  constructor(open) {
    this.open = open;
    this.device = null;
    this.running = null;
    this.pictures = [];
    $("survey").addEventListener("submit", (event) => {
      event.preventDefault();
      if (this.running) this.stop();
      else this.start(new FormData($("survey")));
    });
    $("survey").addEventListener("input", () => this.validate());
    onTheme(() => this.pictures.forEach((each) => each.draw()));
  }

  /** Selects a device, and removes the map of the previous one. */
  use(device) {
    this.device = device;
    this.pictures = [];
    $("pictures").replaceChildren();
    say($("survey-state"));
  }

  /** Deselects the device. The map stays visible. */
  leave() {
    if (this.running) this.stop();
    this.device = null;
  }

  /** Validates the addresses of the form. */
  validate() {
    const { first, last } = $("survey").elements;
    last.setCustomValidity(Number(first.value) > Number(last.value) ? `The last address is below the first one, ${first.value}.` : "");
  }

  async start(form) {
    const areas = form.getAll("areas");
    if (areas.length === 0) {
      say($("survey-state"), "Choose at least one area.");
      return;
    }
    const first = Number(form.get("first"));
    const last = Number(form.get("last"));
    const stopping = new AbortController();
    this.running = stopping;
    this.prepare(areas, first, last);
    const body = { ...this.device, areas, first, last, exact: form.has("exact"), maxStreams: MAX_STREAMS.map };
    const options = { signal: stopping.signal, extraTime: this.device.timeout * areas.length };
    try {
      await stream("/api/modbus/map", body, options, (name, data) => {
        if (this.running === stopping) this.happened(name, data);
      });
      // A result ends the map.
      if (this.running === stopping) throw new Problem("gateway_gone", "the connection to the gateway ended");
    } catch (error) {
      if (this.running === stopping) this.interrupt(notice(error));
    }
  }

  prepare(areas, first, last) {
    this.areas = [];
    this.pictures = areas.map((area) => new Picture(area, first, last, this.open));
    $("pictures").replaceChildren(...this.pictures.map((each) => each.root));
    this.pictures.forEach((each) => each.draw());
    $("survey-progress").hidden = false;
    $("survey-progress").removeAttribute("value");
    $("survey-go").textContent = "Stop";
    say($("survey-state"), "Mapping…");
  }

  happened(name, data) {
    this.areas = data.areas;
    data.areas.forEach((area, at) => this.pictures[at].update(area));
    const found = data.areas.reduce((sum, area) => sum + area.addresses, 0);
    const counted = `${found.toLocaleString("en")} addresses, ${data.requests.toLocaleString("en")} requests`;
    if (name === "progress") {
      $("survey-progress").value = data.at / data.total;
      $("survey-state").firstChild.textContent = `Mapping… ${counted}`;
      return;
    }
    this.pictures.forEach((each) => each.list());
    this.end();
    if (data.success) say($("survey-state"), `Done in ${data.seconds.toFixed(1)} s: ${counted}.`, data.exact ? null : this.sampled(data.areas));
    else say($("survey-state"), notice(new Problem(data.reason ?? "timeout", data.error)), `Until then: ${counted}.`, this.unsearched());
  }

  /** Where a map that ended early did not look; `null` after a complete one. */
  unsearched() {
    const left = this.areas.filter((area) => area.notSearchedFrom !== null);
    const named = left.map((area) => `${AREAS[area.area].title.toLowerCase()} from ${area.notSearchedFrom}`);
    return left.length > 0 ? `Not searched: ${named.join(", ")}.` : null;
  }

  /** Explains that not every address was read, and offers to read them all. */
  sampled(areas) {
    const unread = areas.reduce((sum, area) => sum + area.notAsked, 0);
    return h("p", { class: "offer" }, `${unread.toLocaleString("en")} addresses between samples were not read; short ranges may be among them. `,
      h("button", { type: "button", onclick: () => this.startExact() }, "Read every address (slow)"));
  }

  startExact() {
    $("survey").elements.exact.checked = true;
    $("survey-go").focus();
    $("survey").requestSubmit();
  }

  stop() {
    this.running.abort();
    this.interrupt("Stopped. The map is incomplete: what it does not show as valid is unknown.");
  }

  /** Ends a map without a result. Says why, and lists what was found. */
  interrupt(why) {
    say($("survey-state"), why, this.unsearched());
    if (this.areas.length > 0) this.pictures.forEach((each) => each.list());
    this.end();
  }

  end() {
    this.running = null;
    $("survey-progress").hidden = true;
    $("survey-go").textContent = "Map device";
  }
}

/** One area. A cell stands for some addresses; it is darker the more of them are valid. */
class Picture {
  constructor(area, first, last, open) {
    ({ title: this.title, code: this.code } = AREAS[area]);
    this.whole = this.span = [first, last];
    this.columns = innerWidth < NARROW ? 32 : 64;
    this.open = open;
    this.ranges = [];
    this.absent = null;
    this.failures = {};
    this.count = h("span", { class: "dim" }, "…");
    this.canvas = h("canvas", { role: "img" });
    this.ranged = h("ul", { class: "ranges" });
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    this.canvas.addEventListener("click", (event) => this.zoom(this.addressAt(event), 1 / ZOOM));
    this.ends = [h("span"), h("span"), h("span")];
    this.root = h("article", { class: "card picture" },
      h("header", {}, h("h3", {}, this.title), this.count, this.buttons()),
      this.canvas,
      h("div", { class: "scale" }, this.ends),
      h("p", { class: "legend" }, Object.entries(LEGEND).map(([kind, text]) => h("span", { class: kind }, text))),
      this.ranged);
    new ResizeObserver(() => this.draw()).observe(this.root);
  }

  buttons() {
    const button = (text, label, onclick) => quiet(text, `${label}: ${this.title.toLowerCase()}`, onclick);
    return h("span", { class: "zoom" },
      button("◀", "Lower addresses", () => this.move(-1)),
      button("▶", "Higher addresses", () => this.move(1)),
      button("+", "Zoom in", () => this.zoom(this.middle(), 1 / ZOOM)),
      button("−", "Zoom out", () => this.zoom(this.middle(), ZOOM)));
  }

  get size() {
    return this.span[1] - this.span[0] + 1;
  }

  middle() {
    return this.span[0] + Math.floor(this.size / 2);
  }

  /** Shows `factor` times as many addresses around one. */
  zoom(address, factor) {
    const [first, last] = this.whole;
    const size = Math.min(last - first + 1, Math.max(MIN_SIZE, Math.ceil(this.size * factor)));
    this.show(address - Math.floor(size / 2), size);
  }

  /** Shows the addresses before or after. */
  move(direction) {
    this.show(this.span[0] + direction * Math.ceil(this.size / 2), this.size);
  }

  show(from, size) {
    const [first, last] = this.whole;
    const start = Math.max(first, Math.min(from, last - size + 1));
    this.span = [start, Math.min(last, start + size - 1)];
    this.draw();
  }

  update({ addresses, ranges, absentRanges, failures, givenUp, absent, notAsked }) {
    if (ranges) this.ranges = ranges;
    this.absent = absentRanges ?? null;
    this.failures = failures ?? {};
    this.givenUp = givenUp;
    this.absentText = absentRanges ? `${absent.toLocaleString("en")} asked and absent, ${notAsked.toLocaleString("en")} not asked` : null;
    this.count.textContent = addresses === 1 ? "1 address" : `${addresses.toLocaleString("en")} addresses`;
    this.canvas.setAttribute("aria-label", `${this.title}: ${this.count.textContent} in ${this.ranges.length} ranges${this.absentText ? `, ${this.absentText}` : ""}`);
    this.draw();
  }

  /** Returns the number of addresses of each cell that the ranges contain. */
  filled(ranges) {
    const [first, last] = this.span;
    const cells = new Float32Array(this.columns * this.rows);
    for (const [from, to] of ranges) {
      for (let at = Math.max(from, first); at <= Math.min(to, last); ) {
        const cell = Math.floor((at - first) / this.each);
        const end = Math.min(to, last, first + (cell + 1) * this.each - 1);
        cells[cell] += end - at + 1;
        at = end + 1;
      }
    }
    return cells;
  }

  /** Draws the cells aligned to screen pixels. */
  draw() {
    const [first, last] = this.span;
    this.each = Math.max(1, Math.ceil(this.size / CELLS));
    this.rows = Math.ceil(this.size / this.each / this.columns);
    const per = this.each === 1 ? "1 address per cell" : `${this.each} addresses per cell`;
    [first, per, last].forEach((text, at) => (this.ends[at].textContent = text));
    const room = this.root.clientWidth - 2 * parseFloat(getComputedStyle(this.root).paddingLeft);
    const size = Math.max(3, Math.floor((room * devicePixelRatio) / this.columns));
    this.canvas.width = this.columns * size;
    const height = this.columns < 64 ? Math.ceil(size / 2) : size;
    this.canvas.height = this.rows * height;
    this.canvas.style.width = `${this.canvas.width / devicePixelRatio}px`;
    const context = this.canvas.getContext("2d");
    this.there = this.filled(this.ranges);
    this.wrong = this.filled(Object.values(this.failures).flat());
    this.missing = this.filled(this.absent ?? []);
    const [soft, edge, accent, warm] = ["--line", "--edge", "--accent", "--warm-ink"].map(colour);
    const cells = Math.ceil(this.size / this.each);
    for (let cell = 0; cell < cells; cell += 1) {
      const [left, top] = [(cell % this.columns) * size, Math.floor(cell / this.columns) * height];
      const fill = (style, alpha, side = 1) => {
        const [wide, high] = [size - 1, height - 1].map((each) => Math.max(1, Math.round(each * side)));
        context.globalAlpha = alpha;
        context.fillStyle = style;
        context.fillRect(left + ((size - 1 - wide) >> 1), top + ((height - 1 - high) >> 1), wide, high);
      };
      const [valid, absent] = [this.there[cell] / this.each, this.missing[cell] / this.each];
      if (valid > 0) fill(accent, 0.4 + 0.6 * valid);
      else if (this.wrong[cell] > 0) fill(warm, 0.8);
      else fill(soft, 0.7);
      // What was asked and is absent is a mark inside the cell, larger the more of it was asked.
      if (valid === 0 && this.wrong[cell] === 0 && absent > 0) fill(edge, 0.9, Math.max(0.2, 0.65 * Math.sqrt(absent)));
    }
  }

  /** Returns the first address of the cell that an event is at. */
  addressAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const column = Math.floor(((event.clientX - box.left) / box.width) * this.columns);
    const cell = Math.floor(((event.clientY - box.top) / box.height) * this.rows) * this.columns + column;
    return Math.min(this.span[1], this.span[0] + cell * this.each);
  }

  point(event) {
    const from = this.addressAt(event);
    const cell = Math.floor((from - this.span[0]) / this.each);
    const to = Math.min(this.span[1], from + this.each - 1);
    const failed = this.wrong[cell] > 0 ? `, ${this.wrong[cell]} failed` : "";
    const unread = to - from + 1 - this.there[cell] - this.wrong[cell] - this.missing[cell];
    const rest = this.absent ? `, ${this.missing[cell]} absent, ${unread} not asked` : "";
    this.canvas.title = `${from === to ? from : `${from} to ${to}`}: ${this.there[cell] ?? 0} valid${failed}${rest}`;
  }

  /** Lists the ranges; a click reads a range. */
  list() {
    const items = this.ranges.slice(0, MAX_LISTED).map(([from, to]) => {
      const onclick = () => this.open(this.code, from, to - from + 1);
      const text = from === to ? `${from}` : `${from}–${to}`;
      return h("li", {}, h("button", { type: "button", "aria-label": `Read ${this.title.toLowerCase()} ${text}`, onclick }, text));
    });
    if (this.ranges.length > MAX_LISTED) items.push(h("li", { class: "dim" }, `and ${this.ranges.length - MAX_LISTED} more`));
    for (const [kind, ranges] of Object.entries(this.failures)) {
      const count = ranges.reduce((sum, [from, to]) => sum + to - from + 1, 0);
      items.push(h("li", { class: "wrong" }, `${count} with ${FAILURES[kind] ?? `exception ${kind}`}`));
    }
    if (items.length === 0) items.push(h("li", { class: "dim" }, this.givenUp === 1 ? "The device does not support this area." : "None found."));
    if (this.absentText) items.push(h("li", { class: "dim" }, `${this.absentText}.`));
    this.ranged.replaceChildren(...items);
  }
}
