// Small plots of watched values, one above the other, with a common time axis.

import uPlot from "./vendor/uplot/uPlot.esm.js";
import { $, colour, h, onTheme } from "./dom.js";

const SPAN = 120;
const MOST = 8;
const MOST_POINTS = 5000;
const HEIGHT = 96;
const TICK = 250;

const now = () => Date.now() / 1000;

/** The plots of one watch. */
export class Plots {
  /** `number(address)` returns the current value of an address of the range. */
  constructor(range, number) {
    this.first = range.address;
    this.last = range.address + range.quantity - 1;
    this.number = number;
    this.place = $("plots");
    this.shown = new Map();
    this.chosen = false;
    const input = h("input", { type: "number", min: this.first, max: this.last, id: "plot-address" });
    this.told = h("p", { class: "dim", role: "status" });
    const add = () => this.wish(input.value);
    this.place.replaceChildren(h("div", { class: "bar" },
      h("label", {}, "Plot address", input),
      h("button", { type: "button", onclick: add }, "Add plot"), this.told));
    this.place.hidden = false;
    this.timer = setInterval(() => this.draw(), TICK);
    this.resized = new ResizeObserver(() => this.fit());
    this.resized.observe(this.place);
    onTheme(() => this.restyle());
  }

  /** Adds the plot of a typed address, or shows an error. */
  wish(text) {
    const address = Number(text);
    if (text === "" || !(address >= this.first && address <= this.last)) {
      this.told.textContent = text ? `${text} is not watched, only ${this.first} to ${this.last}.` : `Enter an address from ${this.first} to ${this.last}.`;
    } else if (this.shown.has(address)) {
      this.told.textContent = `${address} is already plotted.`;
    } else {
      this.choose(address);
    }
  }

  /** Adds the plot of an address, or removes it. */
  choose(address) {
    this.told.textContent = "";
    if (this.shown.has(address)) this.remove(address);
    else if (this.shown.size < MOST) this.add(address);
    else this.told.textContent = `There can be at most ${MOST} plots. Remove one first.`;
    this.chosen = true;
  }

  /** Handles a changed value. Until the user chooses plots, the first values that change get one. */
  changed(address) {
    if (!this.chosen && !this.shown.has(address) && this.shown.size < 4) this.add(address);
    this.shown.get(address)?.take(this.number(address));
  }

  add(address) {
    const plot = new Plot(address, () => this.choose(address));
    this.shown.set(address, plot);
    this.place.append(plot.root);
    plot.take(this.number(address));
    plot.show();
  }

  remove(address) {
    this.shown.get(address).end();
    this.shown.delete(address);
  }

  draw() {
    if (document.hidden) return;
    for (const plot of this.shown.values()) plot.draw();
  }

  fit() {
    for (const plot of this.shown.values()) plot.fit();
  }

  restyle() {
    for (const plot of this.shown.values()) plot.show();
  }

  /** Stops updating. */
  stop() {
    clearInterval(this.timer);
  }

  end() {
    this.stop();
    this.resized.disconnect();
    for (const address of [...this.shown.keys()]) this.remove(address);
    this.place.hidden = true;
  }
}

class Plot {
  constructor(address, onRemove) {
    this.address = address;
    this.times = [];
    this.values = [];
    this.output = h("output", { "aria-live": "off" });
    this.extent = h("span", { class: "extent" });
    this.body = h("div", { role: "img", "aria-label": `Plot of address ${address}` });
    const label = `Remove the plot of ${address}`;
    this.root = h("article", { class: "plot" },
      h("header", {}, h("h3", { class: "mono dim" }, String(address)), this.output, this.extent,
        h("button", { class: "quiet", type: "button", "aria-label": label, onclick: onRemove }, "✕")),
      this.body);
  }

  take(value) {
    this.times.push(now());
    this.values.push(value);
    if (this.times.length > MOST_POINTS) {
      this.times.shift();
      this.values.shift();
    }
    this.output.textContent = shortened(value);
    const few = this.values.filter((each) => each !== undefined);
    this.extent.textContent = `${shortened(Math.min(...few))} … ${shortened(Math.max(...few))}`;
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
      axes: [{ ...axis, size: 24, space: 80, values: (_, ticks) => ticks.map(clock) }, { ...axis, size: 58, space: 26, values: (_, ticks) => ticks.map((each) => short(each / this.scale)) }],
    }, [[], []], this.body);
    this.draw();
  }

  draw() {
    const end = now();
    this.scale = scaled(this.values);
    const values = this.values.map((each) => each * this.scale);
    this.plot.batch(() => {
      this.plot.setData([[...this.times, end], [...values, values.at(-1)]], false);
      this.plot.setScale("x", { min: Math.max(end - SPAN, Math.min(this.times[0], end - 10)), max: end });
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

const shortened = (value) => (Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(5))));

/** Formats a number for an axis, where space is limited. */
function short(value) {
  const text = shortened(value);
  return text.length <= 8 ? text : value.toExponential(2).replace("e+", "e");
}

/** Returns a factor for tiny values, because uPlot has no axis steps below 1e-16. */
function scaled(values) {
  const most = Math.max(...values.map(Math.abs));
  return most > 0 && most < 1e-6 ? 10 ** Math.min(300, -Math.floor(Math.log10(most))) : 1;
}

const clock = (seconds) => new Date(1000 * seconds).toTimeString().slice(0, 8);

/** Adds space above and below, also for a flat line. */
function padded(low, high) {
  if (low === null) return [0, 1];
  const room = (high - low) * 0.1 || Math.abs(high) * 0.1 || 1;
  return [low - room, high + room];
}
