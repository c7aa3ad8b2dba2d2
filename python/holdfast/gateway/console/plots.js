// Small plots of watched values, one above the other, with a common time axis.

import uPlot from "./vendor/uplot/uPlot.esm.js";
import { save, stamp } from "./csv.js";
import { $, clock, colour, h, onTheme, quiet, stopwatch } from "./dom.js";
import { History } from "./history.js";

const SPANS = { 120: "2 minutes", 600: "10 minutes", 3600: "1 hour" };
const MAX_PLOTS = 8;
const AUTOMATIC = 4;
const HEIGHT = 96;
const TICK = 250;

/** The plots of one watch. */
export class Plots {
  /** `panels` are the parts of the view; `onChoice()` is called when the plots change. */
  constructor(panels, span, onChoice) {
    this.panels = panels;
    this.span = SPANS[span] ? Number(span) : 120;
    this.onChoice = onChoice;
    this.place = $("plots");
    this.shown = new Map();
    this.chosen = false;
    /** The time of the last poll in seconds, by the clock of the gateway, and what tells how long ago it was. */
    this.latest = 0;
    this.since = stopwatch();
    this.status = h("p", { class: "dim", role: "status" });
    this.place.replaceChildren(h("div", { class: "bar" }, ...this.chooser(),
      h("label", {}, "Time span", this.spans()),
      h("button", { type: "button", onclick: () => this.download() }, "Download plots as CSV"), this.status));
    this.place.hidden = false;
    this.timer = setInterval(() => this.draw(), TICK);
    this.resized = new ResizeObserver(() => this.shown.forEach((plot) => plot.fit()));
    this.resized.observe(this.place);
    this.ended = new AbortController();
    onTheme(() => this.shown.forEach((plot) => plot.show()), this.ended.signal);
  }

  /** Returns what chooses a value: an address of the only range, or one of all values. */
  chooser() {
    const [only, ...more] = this.panels;
    const isRange = more.length === 0 && only.part.kind === "range";
    const place = isRange ? this.addresses(only) : h("select", { id: "plot-cell" }, this.cells().map(([key, text]) => h("option", { value: key }, text)));
    const add = () => (isRange ? this.wish(only, place.value) : this.wishKey(place.value));
    return [h("label", {}, isRange ? "Plot address" : "Plot value", place), h("button", { type: "button", onclick: add }, "Add plot")];
  }

  addresses({ part: { address, quantity } }) {
    return h("input", { type: "number", min: address, max: address + quantity - 1, id: "plot-address" });
  }

  cells() {
    return this.panels.flatMap((panel, at) => panel.cells().map((cell) => [`${at}.${cell}`, panel.label(cell, false)]));
  }

  spans() {
    const onchange = (event) => {
      this.span = Number(event.target.value);
      this.draw();
      this.onChoice();
    };
    return h("select", { id: "plot-span", onchange }, Object.entries(SPANS).map(([seconds, text]) =>
      h("option", { value: seconds, selected: Number(seconds) === this.span }, text)));
  }

  /** Adds the plot of a typed address, or shows an error. */
  wish({ part: { address: first, quantity } }, text) {
    const address = Number(text);
    const last = first + quantity - 1;
    if (text === "" || !(address >= first && address <= last)) {
      this.status.textContent = text ? `${text} is not watched, only ${first} to ${last}.` : `Enter an address from ${first} to ${last}.`;
    } else {
      this.wishKey(`0.${address}`);
    }
  }

  wishKey(key) {
    if (this.shown.has(key)) this.status.textContent = `${this.shown.get(key).label} is already plotted.`;
    else this.toggle(key);
  }

  /** Adds the plot of a value, or removes it. */
  toggle(key) {
    this.status.textContent = "";
    if (this.shown.has(key)) this.remove(key);
    else if (this.shown.size < MAX_PLOTS) this.add(key);
    else this.status.textContent = `There can be at most ${MAX_PLOTS} plots. Remove one first.`;
    this.chosen = true;
    this.onChoice();
  }

  /** Shows plots that the user chose earlier, instead of the automatic ones. */
  restore(keys) {
    this.shown.forEach((_, key) => this.remove(key));
    keys.forEach((key) => this.toggle(key));
  }

  /** Handles a changed value. Until the user chooses plots, the first values that change get one. */
  changed(panel, cell) {
    const key = `${this.panels.indexOf(panel)}.${cell}`;
    if (!this.chosen && !this.shown.has(key) && this.shown.size < AUTOMATIC) this.add(key);
  }

  /** Returns the time in seconds, by the clock of the gateway. */
  now() {
    return this.latest + this.since() / 1000;
  }

  /**
   * Takes the values of a poll, with its time in seconds. A part that was not answered has a gap. If the clock of the
   * gateway was set back, what is plotted moves with it, and keeps its order.
   */
  poll(time) {
    if (time < this.latest) this.shown.forEach((plot) => plot.history.move(time - this.latest));
    this.latest = time;
    this.since = stopwatch();
    for (const plot of this.shown.values()) plot.take(time);
  }

  /** Marks that nothing is known since the last poll. */
  gap() {
    for (const plot of this.shown.values()) plot.gap();
  }

  /** Returns the keys of the plots that the user has chosen; null if none were chosen. */
  keys() {
    return this.chosen ? [...this.shown.keys()] : null;
  }

  add(key) {
    const dot = key.indexOf(".");
    const panel = this.panels[Number(key.slice(0, dot))];
    const cell = panel?.cells().find((each) => String(each) === key.slice(dot + 1));
    if (cell === undefined) return;
    const plot = new Plot(this, panel, cell, panel.label(cell, this.panels.length === 1), () => this.toggle(key));
    this.shown.set(key, plot);
    this.place.append(plot.root);
    plot.take(this.latest);
    plot.show();
  }

  remove(key) {
    this.shown.get(key).end();
    this.shown.delete(key);
  }

  /** Saves the points that are drawn. A gap is a row without a value. */
  download() {
    const start = this.now() - this.span;
    const rows = [...this.shown.values()].flatMap((plot) => {
      const [times, , texts] = plot.history.points();
      return times.flatMap((time, at) => (time < start ? [] : [[new Date(1000 * time).toISOString(), plot.label, texts[at] ?? ""]]));
    });
    save(`plots-${stamp()}.csv`, [["time", "name", "value"], ...rows.sort(([a], [b]) => (a < b ? -1 : Number(a > b)))]);
  }

  draw() {
    if (document.hidden) return;
    for (const plot of this.shown.values()) plot.draw();
  }

  /** Stops updating. The plots stay as they are. */
  stop() {
    const since = this.since();
    this.since = () => since;
    this.draw();
    clearInterval(this.timer);
  }

  end() {
    this.stop();
    this.resized.disconnect();
    this.ended.abort();
    for (const key of [...this.shown.keys()]) this.remove(key);
    this.place.hidden = true;
  }
}

class Plot {
  constructor(plots, panel, cell, label, onRemove) {
    Object.assign(this, { plots, panel, cell, label });
    this.history = new History();
    this.output = h("output", { "aria-live": "off" });
    this.extent = h("span", { class: "extent" });
    this.body = h("div", { role: "img", "aria-label": `Plot of ${label}` });
    this.root = h("article", { class: "plot" },
      h("header", {}, h("h3", { class: "mono dim" }, label), this.output, this.extent,
        quiet("✕", `Remove the plot of ${label}`, onRemove)),
      this.body);
  }

  take(time) {
    const value = this.panel.isStale ? null : this.panel.number(this.cell);
    if (value === null || value === undefined) {
      this.gap();
      return;
    }
    this.history.take(time, value, this.panel.digits(this.cell));
    this.output.textContent = this.panel.text(this.cell) ?? String(value);
    this.root.classList.remove("old");
    this.describe();
  }

  gap() {
    this.history.gap();
    this.root.classList.add("old");
    if (this.output.textContent === "") this.output.textContent = "–";
    this.describe();
  }

  /** Shows the extremes and the gaps of the time span. */
  describe() {
    const now = this.plots.now();
    const start = now - this.plots.span;
    const [times, values] = this.history.points();
    let [least, greatest] = [Infinity, -Infinity];
    values.forEach((value, at) => {
      if (value === null || (times[at + 1] ?? Infinity) < start) return;
      least = Math.min(least, value);
      greatest = Math.max(greatest, value);
    });
    const extent = least > greatest ? "" : `${shortened(least)} … ${shortened(greatest)}`;
    const gaps = this.history.gaps().filter(([, end]) => end === null || end >= start);
    const open = this.root.classList.contains("old");
    this.extent.textContent = open ? `no value since ${timeOf(this.history.until || now)}` : extent;
    const gapText = gaps.length === 0 ? "" : `, ${gaps.length} ${gaps.length === 1 ? "gap" : "gaps"}`;
    this.body.setAttribute("aria-label", `Plot of ${this.label}${gapText}`);
  }

  /** Creates the plot again, in the current colors. */
  show() {
    this.plot?.destroy();
    this.scale = 1;
    const axis = { stroke: colour("--dim"), grid: { stroke: colour("--grid"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
    this.plot = new uPlot({
      width: this.width(),
      height: HEIGHT,
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: true }, y: { range: (_, low, high) => padded(low, high) } },
      series: [{}, { stroke: colour("--plot"), width: 1.75, points: { show: false }, paths: uPlot.paths.stepped({ align: 1 }) }],
      axes: [{ ...axis, size: 24, space: 80, values: (_, ticks) => ticks.map(timeOf) }, { ...axis, size: 58, space: 26, values: (_, ticks) => ticks.map((each) => short(each / this.scale)) }],
      hooks: { drawClear: [(plot) => this.shade(plot)] },
    }, [[], []], this.body);
    this.draw();
  }

  /** Colors the times without a value. */
  shade(plot) {
    const { left, width, top, height } = plot.bbox;
    const right = left + width;
    plot.ctx.save();
    plot.ctx.fillStyle = colour("--warm");
    for (const [start, end] of this.history.gaps()) {
      const from = Math.max(left, plot.valToPos(start, "x", true));
      const to = end === null ? right : Math.min(right, plot.valToPos(end, "x", true));
      if (to > from) plot.ctx.fillRect(from, top, Math.max(to - from, 2), height);
    }
    plot.ctx.restore();
  }

  draw() {
    const end = this.plots.now();
    const [allTimes, allValues] = this.history.points();
    const start = end - this.plots.span;
    let first = allTimes.findIndex((time) => time >= start);
    first = Math.max(0, (first < 0 ? allTimes.length : first) - 1);
    const times = allTimes.slice(first);
    const values = allValues.slice(first);
    this.scale = scaled(values);
    const drawn = this.scale === 1 ? values : values.map((each) => (each === null ? null : each * this.scale));
    this.plot.batch(() => {
      this.plot.setData([times, drawn], false);
      this.plot.setScale("x", { min: Math.max(start, Math.min(times[0] ?? end, end - 10)), max: end });
    });
  }

  width() {
    return Math.max(120, this.body.clientWidth || 260);
  }

  fit() {
    if (this.plot && this.plot.width !== this.width()) this.plot.setSize({ width: this.width(), height: HEIGHT });
  }

  end() {
    this.plot?.destroy();
    this.root.remove();
  }
}

/** Formats a number with five digits, or an integer with all of them, if a number can have them. */
function shortened(value) {
  if (Number.isSafeInteger(value)) return String(value);
  const text = value.toPrecision(5);
  return Number.isInteger(value) ? text : String(Number(text));
}

/** Formats a number for an axis, where space is limited. */
function short(value) {
  const text = shortened(value);
  return text.length <= 8 ? text : value.toExponential(2).replace("e+", "e");
}

/** Returns a factor for tiny values, because uPlot has no axis steps below 1e-16. */
function scaled(values) {
  const most = values.reduce((most, each) => Math.max(most, Math.abs(each ?? 0)), 0);
  return most > 0 && most < 1e-6 ? 10 ** Math.min(300, -Math.floor(Math.log10(most))) : 1;
}

const timeOf = (seconds) => clock(1000 * seconds);

/** Adds space above and below, also for a flat line. */
function padded(low, high) {
  if (low === null) return [0, 1];
  const room = (high - low) * 0.1 || Math.abs(high) * 0.1 || 1;
  return [low - room, high + room];
}
