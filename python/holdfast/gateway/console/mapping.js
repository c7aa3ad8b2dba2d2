// The map of a device: a picture of each area, and a list of its ranges.

import { notice, stream } from "./api.js";
import { $, colour, h, onTheme, say } from "./dom.js";
import { AREAS } from "./standard.js";

const FAILURES = { timeout: "no response", connection: "connection lost", invalid: "invalid response" };
const CELLS = 1024;
const NARROW = 640;
const MOST_LISTED = 200;

/** The map view. `open` shows a range in the values view. */
export class Map_ {
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
    const body = JSON.stringify({ ...this.device, areas, first, last, exact: form.has("exact") });
    try {
      await stream("/api/modbus/map", { method: "POST", body, signal: stopping.signal }, (name, data) => {
        if (this.running === stopping) this.happened(name, data);
      });
    } catch (error) {
      if (this.running === stopping) say($("survey-state"), notice(error));
    }
    if (this.running === stopping) this.end();
  }

  prepare(areas, first, last) {
    this.pictures = areas.map((area) => new Picture(area, first, last, this.open));
    $("pictures").replaceChildren(...this.pictures.map((each) => each.root));
    this.pictures.forEach((each) => each.draw());
    $("survey-progress").hidden = false;
    $("survey-progress").removeAttribute("value");
    $("survey-go").textContent = "Stop";
    say($("survey-state"), "Mapping…");
  }

  happened(name, data) {
    data.areas.forEach((area, at) => this.pictures[at].update(area));
    const found = data.areas.reduce((sum, area) => sum + area.addresses, 0);
    const counted = `${found.toLocaleString("en")} addresses, ${data.requests.toLocaleString("en")} requests`;
    if (name === "progress") {
      $("survey-progress").value = data.at / data.total;
      $("survey-state").firstChild.textContent = `Mapping… ${counted}`;
      return;
    }
    this.pictures.forEach((each) => each.list());
    if (data.success) say($("survey-state"), `Done in ${data.seconds.toFixed(1)} s: ${counted}.`, data.exact ? null : this.sampled(data.areas));
    else say($("survey-state"), notice(Object.assign(new Error(data.error), { reason: data.reason ?? "timeout" })), `Until then: ${counted}.`);
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
    this.start(new FormData($("survey")));
  }

  stop() {
    this.running.abort();
    say($("survey-state"), "Stopped. The map is incomplete.");
    this.pictures.forEach((each) => each.list());
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
    this.first = first;
    this.columns = innerWidth < NARROW ? 32 : 64;
    this.each = Math.max(1, Math.ceil((last - first + 1) / CELLS));
    this.rows = Math.ceil((last - first + 1) / this.each / this.columns);
    this.open = open;
    this.ranges = [];
    this.failures = {};
    this.count = h("span", { class: "dim" }, "…");
    this.canvas = h("canvas", { role: "img" });
    this.ranged = h("ul", { class: "ranges" });
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    const per = this.each === 1 ? "1 address per cell" : `${this.each} addresses per cell`;
    this.root = h("article", { class: "card picture" },
      h("header", {}, h("h3", {}, this.title), this.count),
      this.canvas,
      h("div", { class: "scale" }, h("span", {}, String(first)), h("span", {}, per), h("span", {}, String(last))),
      this.ranged);
    new ResizeObserver(() => this.draw()).observe(this.root);
  }

  update({ addresses, ranges, failures, givenUp }) {
    if (ranges) this.ranges = ranges;
    this.failures = failures ?? {};
    this.givenUp = givenUp;
    this.count.textContent = addresses === 1 ? "1 address" : `${addresses.toLocaleString("en")} addresses`;
    this.canvas.setAttribute("aria-label", `${this.title}: ${this.count.textContent} in ${this.ranges.length} ranges`);
    this.draw();
  }

  /** Returns the number of addresses of each cell that the ranges contain. */
  filled(ranges) {
    const cells = new Float32Array(this.columns * this.rows);
    for (const [from, to] of ranges) {
      for (let at = from; at <= to; ) {
        const cell = Math.floor((at - this.first) / this.each);
        const end = Math.min(to, this.first + (cell + 1) * this.each - 1);
        cells[cell] += end - at + 1;
        at = end + 1;
      }
    }
    return cells;
  }

  /** Draws the cells aligned to screen pixels. */
  draw() {
    const room = this.root.clientWidth - 2 * parseFloat(getComputedStyle(this.root).paddingLeft);
    const size = Math.max(3, Math.floor((room * devicePixelRatio) / this.columns));
    this.canvas.width = this.columns * size;
    const height = this.columns < 64 ? Math.ceil(size / 2) : size;
    this.canvas.height = this.rows * height;
    this.canvas.style.width = `${this.canvas.width / devicePixelRatio}px`;
    const context = this.canvas.getContext("2d");
    this.there = this.filled(this.ranges);
    const wrong = this.filled(Object.values(this.failures).flat());
    const [soft, accent, warm] = [colour("--line"), colour("--accent"), colour("--warm-ink")];
    for (let cell = 0; cell < this.there.length; cell += 1) {
      const part = this.there[cell] / this.each;
      context.globalAlpha = part > 0 ? 0.4 + 0.6 * part : wrong[cell] > 0 ? 0.8 : 0.6;
      context.fillStyle = part > 0 ? accent : wrong[cell] > 0 ? warm : soft;
      context.fillRect((cell % this.columns) * size, Math.floor(cell / this.columns) * height, size - 1, height - 1);
    }
  }

  point(event) {
    const box = this.canvas.getBoundingClientRect();
    const column = Math.floor(((event.clientX - box.left) / box.width) * this.columns);
    const cell = Math.floor(((event.clientY - box.top) / box.height) * this.rows) * this.columns + column;
    const from = this.first + cell * this.each;
    this.canvas.title = `${from}${this.each > 1 ? ` to ${from + this.each - 1}` : ""}: ${this.there[cell] ?? 0} valid`;
  }

  /** Lists the ranges; a click reads a range. */
  list() {
    const items = this.ranges.slice(0, MOST_LISTED).map(([from, to]) => {
      const onclick = () => this.open(this.code, from, to - from + 1);
      const text = from === to ? `${from}` : `${from}–${to}`;
      return h("li", {}, h("button", { type: "button", "aria-label": `Read ${this.title.toLowerCase()} ${text}`, onclick }, text));
    });
    if (this.ranges.length > MOST_LISTED) items.push(h("li", { class: "dim" }, `and ${this.ranges.length - MOST_LISTED} more`));
    for (const [kind, ranges] of Object.entries(this.failures)) {
      const count = ranges.reduce((sum, [from, to]) => sum + to - from + 1, 0);
      items.push(h("li", { class: "wrong" }, `${count} with ${FAILURES[kind] ?? `exception ${kind}`}`));
    }
    if (items.length === 0) items.push(h("li", { class: "dim" }, this.givenUp === 1 ? "The device does not support this area." : "None found."));
    this.ranged.replaceChildren(...items);
  }
}
