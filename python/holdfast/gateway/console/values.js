// The values view: reads or watches ranges and tag lists, and offers plots and writes.

import { notice, Problem } from "./api.js";
import { save, stamp } from "./csv.js";
import { $, h, pause, quiet, say, show, stopwatch } from "./dom.js";
import { Lists } from "./lists.js";
import { flaw, modicon, typeOf } from "./numbers.js";
import * as pageUrl from "./page_url.js";
import * as parts from "./parts.js";
import { Plots } from "./plots.js";
import { areaOf, LAST_ADDRESS } from "./standard.js";
import { MAX_STREAMS, stream } from "./streams.js";
import { Table } from "./table.js";
import { TagTable } from "./tags.js";
import { Writer } from "./write_dialog.js";

/** Milliseconds that news may be late. */
const SLACK = 2 * 1000;

const PATH = "/api/modbus/watch/view";
/** How long a watch waits before it retries, in milliseconds. */
export const RESUME = 1000;
const WRITTEN = { written: "Written", refused: "Not written", unknown: "Unknown whether it was written" };
/** Errors after which a watch does not retry. */
export const FINAL = new Set(["malformed", "refused_target", "unauthorized", "foreign_page", "not_found"]);
const CSV = ["time", "part", "name", "area", "address", "type", "order", "value", "unit", "state", "error"];
const CHECK = 1000;
/** The most bytes of all parts: the body of a request has 64 KiB, with the device and the settings. */
const MAX_PARTS_SIZE = 63 * 1024;
/** How long the first poll of a tag list may take, in milliseconds: each of its tags may need a request. */
const LONG = 15 * 60_000;

/** The values view. `gateway.allowsWrites` is `null` until `gateway.refresh()` has found out. */
export class Values {
  constructor(gateway) {
    this.gateway = gateway;
    this.writer = new Writer();
    this.lists = new Lists((part) => this.pin(part));
    this.pinned = [];
    this.panels = [];
    this.flaws = [];
    this.device = this.plots = this.watching = this.reading = this.heard = null;
    /** Counts what reads the values of the tables: what began last has the newest. */
    this.turn = 0;
    $("range").addEventListener("submit", (event) => {
      event.preventDefault();
      // The parts of a view are read without the form.
      if (this.pinned.length > 0 || $("range").reportValidity()) this.read(this.wanted());
    });
    $("range").addEventListener("input", () => {
      this.adapt();
      this.remember();
    });
    $("type").addEventListener("change", () => {
      $("size").value = $("type").value === "bit" ? 0 : 20;
      this.adapt();
      this.remember();
    });
    $("watch").addEventListener("click", () => {
      if (this.watching) this.stop();
      else if ($(this.pinned.length > 0 ? "interval" : "range").reportValidity()) this.watch(this.wanted());
    });
    $("add-range").addEventListener("click", () => {
      if (!$("range").reportValidity()) return;
      try {
        this.pin(this.range());
      } catch (error) {
        say($("outcome"), error.message);
      }
    });
    $("add-tags").addEventListener("click", () => this.lists.ask());
    $("save").addEventListener("click", () => this.save());
    setInterval(() => this.check(), CHECK);
    this.adapt();
  }

  /** Fills in the view of the page's URL; `found` says what else of it can't be used. Returns whether it is watched. */
  async recall(found) {
    const view = pageUrl.view();
    pageUrl.fill(view.range);
    this.adapt();
    for (const text of view.parts) {
      try {
        this.pinned.push(await pageUrl.readPart(text));
      } catch (error) {
        found.push(error.message);
      }
    }
    // With parts, the range is not used, but the interval is.
    found.push(...pageUrl.unfit(view.range.filter(([id]) => id === "interval" || view.parts.length === 0)));
    this.flaws = found.map((each) => `A part of the link can't be used: ${each}. Nothing is watched by itself.`);
    this.chips();
    this.resumes = view.watched;
    // Plots have the numbers of their parts.
    this.plotted = found.length > 0 ? [] : view.plotted;
    this.span = view.span;
    return this.resumes;
  }

  /** Stores the view in the page's URL. */
  async remember() {
    const pinned = this.pinned;
    const spelled = await Promise.all(pinned.map(pageUrl.spelled));
    if (this.pinned !== pinned) return;
    this.flaws = [];
    pageUrl.putValues((id) => ($(id).disabled ? null : $(id).value), {
      parts: spelled,
      watched: this.watching !== null,
      plotted: this.plots?.keys() ?? this.plotted ?? [],
      span: this.plots ? String(this.plots.span) : this.span ?? null,
    });
  }

  /** Selects a device, and removes the values of the previous one. */
  use(device) {
    this.device = device;
    this.plots?.end();
    this.plots = null;
    this.panels = [];
    $("table").replaceChildren(h("p", { class: "card empty" }, "Choose a range, then read or watch it."));
    $("save").hidden = true;
    say($("outcome"), ...this.flaws);
    // What is left of a damaged link is not what was asked for.
    if (this.resumes && this.flaws.length === 0) this.watch(this.wanted(), null, true);
    this.resumes = false;
  }

  /** Deselects the device. The last values stay visible, marked as stale. */
  leave() {
    this.stop();
    this.device = null;
    this.panels.forEach((panel) => panel.stale());
  }

  /** Adapts the form to area and type, and validates it. */
  adapt() {
    const area = Number($("area").value);
    const ofBits = area < 3;
    const kind = $("type").value;
    const ofLetters = !ofBits && $("order").value === "letters";
    for (const id of ["type", "order"]) show($(id), !ofBits);
    show($("letters"), ofLetters);
    show($("size"), !ofBits && ["bit", "string", "bytes"].includes(kind));
    $("size-name").textContent = kind === "bit" ? "Bit number" : "Bytes per value";
    [$("size").min, $("size").max] = kind === "bit" ? [0, 15] : [1, 250];
    $("quantity").max = areaOf(area).most;
    const address = Number($("address").value);
    $("modicon").textContent = Number.isInteger(address) && address >= 0 ? `= ${modicon(area, address)}` : "";
    const past = address + whole(Number($("quantity").value), this.type().width) > LAST_ADDRESS + 1;
    $("quantity").setCustomValidity(past ? `The last address is ${LAST_ADDRESS}: at most ${LAST_ADDRESS + 1 - address} from ${address}.` : "");
    $("letters").setCustomValidity(ofLetters ? flaw(this.order(), this.type()) : "");
  }

  type() {
    return Number($("area").value) < 3 ? typeOf("bool") : typeOf($("type").value, Number($("size").value));
  }

  order() {
    return $("order").value === "letters" ? $("letters").value.trim().toUpperCase() : $("order").value;
  }

  /** Reads a range of the map, as much of it as one read allows. */
  open(area, address, length) {
    $("area").value = area;
    $("address").value = address;
    this.adapt();
    const most = Number($("quantity").max);
    if (length <= most && length % this.type().width > 0) $("type").value = "uint16";
    $("quantity").value = whole(Math.min(length, most), this.type().width);
    this.adapt();
    this.remember();
    this.read([this.range()], length > most ? `The range has ${length.toLocaleString("en")} addresses; one read covers only a part of it.` : null);
  }

  /** Returns the range of the form, with the quantity rounded to whole values of the type. */
  range() {
    const type = this.type();
    const asked = Number($("quantity").value);
    const quantity = whole(asked, type.width);
    $("quantity").value = quantity;
    const range = parts.range(Number($("area").value), Number($("address").value), quantity, type, this.order());
    const note = asked === quantity ? null : `Each ${type.name} has ${type.width} registers: ${quantity} instead of ${asked}.`;
    return { ...range, note };
  }

  /** Returns the parts that are read and watched: those of the view, or the range of the form. */
  wanted() {
    return this.pinned.length > 0 ? this.pinned : [this.range()];
  }

  /** Adds a part to the view. Throws an error if the gateway would not take the view. */
  pin(part) {
    const pinned = [...this.pinned, part];
    const size = new TextEncoder().encode(JSON.stringify(pinned.map(parts.asked))).length;
    if (size > MAX_PARTS_SIZE) throw new Error(`The parts of a view have at most ${MAX_PARTS_SIZE} bytes together. With this one, they have ${size}.`);
    this.pinned = pinned;
    this.repinned();
  }

  unpin(part) {
    this.pinned = this.pinned.filter((each) => each !== part);
    this.repinned();
  }

  repinned() {
    this.plotted = [];
    this.chips();
    if (this.watching) this.watch(this.wanted());
    else this.remember();
  }

  /** Shows the parts of the view. */
  chips() {
    const items = this.pinned.map((part) =>
      h("li", {}, part.title, quiet("✕", `Remove ${part.title} from the view`, () => this.unpin(part))));
    $("parts").replaceChildren(...items);
    $("parts").hidden = $("parts-help").hidden = items.length === 0;
  }

  /** Asks for a stream of parts of the device. */
  stream(wanted, more, signal, onEvent) {
    const body = { ...this.device, parts: wanted.map(parts.asked), ...more };
    const extraTime = wanted.reduce((sum, part) => sum + (part.kind === "tags" ? LONG : this.device.timeout), 0);
    return stream(PATH, body, { signal, extraTime }, onEvent);
  }

  /** Reads parts once. Returns the data of the event. */
  async once(wanted, signal) {
    let data = null;
    await this.stream(wanted, { once: true }, signal, (_, found) => (data = found));
    if (data === null) throw new Problem("gateway_gone", "the connection to the gateway ended");
    return data;
  }

  async read(wanted, more = null) {
    this.stop();
    const reading = { wanted, request: new AbortController() };
    this.reading = reading;
    this.turn += 1;
    say($("outcome"), "Reading…", more);
    const note = wanted.length === 1 ? wanted[0].note ?? null : null;
    try {
      const began = performance.now();
      const data = await this.once(wanted, reading.request.signal);
      if (this.reading !== reading) return;
      const took = `read in ${Math.round(performance.now() - began)} ms.`;
      const [first] = data.parts;
      if (data.parts.length === 1 && first.error) throw new Problem(first.reason, first.error, first.code);
      this.show(wanted, data);
      this.take(data, false);
      const failed = data.parts.filter((each) => each.error).length;
      say($("outcome"), wanted.length === 1 ? `${wanted[0].title}: ${took}`
        : `${wanted.length - failed} of ${wanted.length} parts: ${took}`, note, more);
    } catch (error) {
      if (this.reading !== reading) return;
      this.panels.forEach((panel) => panel.stale("The last read failed."));
      say($("outcome"), notice(error), note, more);
    }
    this.reading = null;
  }

  /** Shows tables for parts. */
  show(wanted, data) {
    this.plots?.end();
    this.plots = null;
    this.panels = wanted.map((each, at) => this.panel(each, data.parts[at].tags ?? this.panels[at]?.tags));
    $("table").replaceChildren(...this.panels.map((panel) => panel.place));
    if (wanted.length > 1) this.panels.forEach((panel) => (panel.heading.hidden = false));
    this.wholes = wanted;
    $("save").hidden = false;
    this.permit();
  }

  /** Offers writes if the gateway allows them now. Nothing else of the tables changes, nor do the plots. */
  permit() {
    this.panels.forEach((panel) => panel.permit(this.gateway.allowsWrites === true));
    $("only-reads").hidden = this.gateway.allowsWrites !== false;
  }

  panel(whole, tags) {
    const part = { ...whole, device: this.device };
    const writes = part.kind === "tags" || part.area === 1 || part.area === 3;
    const actions = {
      write: writes ? (cell) => this.write(panel, cell) : null,
      plot: (cell) => this.plot(panel, cell),
    };
    const panel = part.kind === "tags" ? new TagTable(part, tags, actions) : new Table(part, actions);
    panel.whole = whole;
    return panel;
  }

  async write(panel, cell) {
    // The outcome of another write must not be taken for that of this one.
    if (!this.watching) say($("outcome"));
    const outcome = await this.writer.ask(panel.target(cell));
    if (outcome === null) return;
    // A reload of the gateway may have taken the right to write.
    if (outcome === "refused") await this.gateway.refresh().catch(() => {});
    const outcomeText = WRITTEN[outcome];
    const { device } = panel.part;
    const isShown = () => this.panels.includes(panel) && this.device === device;
    const where = `${outcomeText}: ${cell} of ${parts.hostAndPort(device)}.`;
    const sayOutcome = () => say($("outcome"), this.watching && isShown() ? `${outcomeText}. The watch continues.` : where);
    if (this.device !== device) return sayOutcome();
    // What is read already may be older than the write.
    if (this.watching) {
      this.watching.request.abort();
      return sayOutcome();
    }
    if (this.reading) return this.read(this.reading.wanted, where);
    const turn = (this.turn += 1);
    // A watch or another read may have begun meanwhile. Its values are newer than these.
    const isNewest = () => this.device === device && this.turn === turn;
    try {
      const data = await this.once(this.wholes);
      if (!isNewest()) return sayOutcome();
      if (!this.fits(data)) this.show(this.wholes, data);
      this.take(data, true);
      const own = data.parts[this.wholes.indexOf(panel.whole)];
      if (!own) return sayOutcome();
      if (own.error) throw new Problem(own.reason, own.error, own.code);
      const changed = `${outcomeText} and read back. Changes are marked.`;
      say($("outcome"), outcome === "written" ? changed : `${outcomeText}. The table shows the values read back.`);
    } catch (error) {
      if (!isNewest()) return sayOutcome();
      (this.panels.includes(panel) ? [panel] : this.panels).forEach((each) => each.stale("Reading back failed."));
      say($("outcome"), notice(error, `${outcomeText}. Reading back failed.`));
    }
  }

  /** Adds or removes the plot of a value. Starts a watch if necessary. */
  plot(panel, cell) {
    const key = `${this.panels.indexOf(panel)}.${cell}`;
    if (!this.watching) {
      if (!$("interval").reportValidity()) return;
      this.watch(this.wholes, [key]);
    } else if (this.plots) {
      this.plots.toggle(key);
    }
  }

  /**
   * Watches parts until it is stopped. Asks again when the request ends or is aborted, and polls without streams. If the
   * first request fails, it ends, unless it is to try `again`.
   */
  async watch(wanted, plotted = null, again = false) {
    this.stop();
    const watch = { request: null };
    this.watching = watch;
    this.turn += 1;
    const signature = JSON.stringify(wanted.map(parts.asked));
    this.plotted = plotted ?? ([undefined, signature].includes(this.signature) ? this.plotted : []);
    this.signature = signature;
    this.interval = Number($("interval").value);
    this.began = this.polls = false;
    this.took = 0;
    this.reported = "";
    this.plots?.end();
    this.plots = null;
    this.pressed(true);
    this.remember();
    say($("outcome"), "Reading…");
    let lastReason = null;
    while (this.watching === watch) {
      watch.request = new AbortController();
      const { signal } = watch.request;
      let streams = null; // Known from the `view` event, which says what the changes after it are of.
      // The profiles of the gateway may change at any time, other lists never do.
      const describe = !this.polls || wanted.some((part) => part.source?.profile);
      const more = { interval: this.interval, maxStreams: MAX_STREAMS.watch, describe };
      try {
        if (lastReason !== null) await this.gateway.refresh();
        await this.stream(wanted, more, signal, (name, data) => {
          if (this.watching !== watch) return;
          if (name === "view") {
            streams = data.stream;
            this.opened(wanted, data);
          } else if (name === "change" && streams !== null) {
            this.take(data, true);
          }
          lastReason = null;
        });
        if (this.watching !== watch) return;
        if (streams === false) {
          await pause(this.interval, signal);
          continue;
        }
        lastReason = this.interrupted(null, lastReason);
      } catch (error) {
        if (this.watching !== watch) return;
        if (signal.aborted) continue;
        if (!(this.began || again) || FINAL.has(error.reason)) {
          this.stop();
          this.panels.forEach((panel) => panel.stale("The watch has ended."));
          say($("outcome"), notice(error));
          return;
        }
        lastReason = this.interrupted(error, lastReason);
      }
      await pause(RESUME);
    }
  }

  /** Handles the first event of a stream. */
  opened(wanted, data) {
    const first = !this.began;
    this.began = true;
    if (first || !this.fits(data)) {
      const same = this.wholes === wanted && this.panels.length > 0 && this.panels[0].part.device === this.device;
      if (!same || !this.fits(data)) this.show(wanted, data);
      this.plots = new Plots(this.panels, this.span, () => this.remember());
    }
    if (this.polls === data.stream || first || this.reported === null) {
      this.polls = !data.stream;
      this.reported = "";
      this.report(data.parts.map(() => null), true);
    }
    this.take(data, true);
    if (first && this.plotted?.length > 0) this.plots.restore(this.plotted);
  }

  /** Returns whether the tables have the tags of an event. */
  fits(data) {
    return data.parts.every((each, at) => !each.tags || parts.same(each.tags, this.panels[at].tags));
  }

  /** Takes the values of an event. */
  take(data, mark) {
    if (this.isLate()) this.plots?.gap();
    this.heard = stopwatch();
    this.took = data.rtt;
    const isView = "stream" in data;
    const changes = isView ? data.parts.map((each, part) => ({ ...each, part })) : data.parts;
    const errors = this.panels.map((panel) => panel.error ?? null);
    const changed = [];
    for (const each of changes) {
      const panel = this.panels[each.part];
      if ("error" in each || isView) errors[each.part] = each.error ? new Problem(each.reason, each.error, each.code) : null;
      if (isView && !each.values) continue;
      const isFirst = panel.values.length === 0;
      const cells = isView ? panel.set(each, mark && !isFirst) : panel.change(each, mark);
      if (!isFirst) changed.push(...cells.map((cell) => [panel, cell]));
    }
    this.panels.forEach((panel, at) => {
      panel.error = errors[at];
      if (errors[at]) panel.stale(this.watching ? "The last poll failed." : "The last read failed.", this.panels.length > 1 ? errors[at] : null);
      else panel.fresh(data.time, this.watching === null);
    });
    if (this.watching && this.plots) {
      this.plots.poll(data.time / 1000);
      for (const [panel, cell] of changed) this.plots.changed(panel, cell);
    }
    if (this.watching) this.report(errors);
  }

  /** Says what is watched, or why nothing is. Each reason is said once. */
  report(errors, anew = false) {
    const failed = errors.filter((each) => each !== null);
    const all = failed.length === errors.length && failed.every((each) => each.message === failed[0].message);
    const key = all ? failed[0].message : "watching";
    if (key === this.reported && !anew) return;
    this.reported = key;
    if (all) {
      say($("outcome"), notice(failed[0]), "Retrying…");
      return;
    }
    const [first, ...others] = this.panels;
    const what = others.length > 0 ? `${others.length + 1} parts` : first.part.kind === "tags" ? first.part.title : first.part.title.toLowerCase();
    const polls = this.polls ? "Other tabs use the streams of this browser. This tab asks for each value, which changes nothing else." : null;
    say($("outcome"), `Watching ${what}, every ${this.interval} ms.`, others.length > 0 ? null : first.part.note ?? null, polls);
  }

  /** Handles an interrupted watch. Shows each reason once. */
  interrupted(error, lastReason) {
    const reason = error?.reason ?? "ended";
    this.panels.forEach((panel) => panel.stale("The gateway does not answer."));
    this.plots?.gap();
    this.reported = null;
    const gone = ["ended", "gateway_gone"];
    if (reason === lastReason || (gone.includes(reason) && gone.includes(lastReason))) return lastReason;
    const goes = "The watch resumes automatically. Press Stop to end it.";
    if (gone.includes(reason)) say($("outcome"), "The gateway ended the watch or does not answer. The watch resumes automatically when the gateway is back. Press Stop to end it.");
    else say($("outcome"), notice(error), goes);
    return reason;
  }

  /** The time in milliseconds after which values without an event are old. */
  lateAfter() {
    return 3 * (this.interval + this.took) + (this.device?.timeout ?? 0) * Math.max(1, this.panels.length) + SLACK;
  }

  /** Returns whether the last event is so long ago. */
  isLate() {
    return this.heard !== null && this.heard() > this.lateAfter();
  }

  /** Marks the values as old if the gateway is silent. */
  check() {
    if (!this.watching || !this.began || !this.isLate()) return;
    this.panels.forEach((panel) => panel.stale("No news from the gateway."));
    this.plots?.gap();
  }

  /** Saves what is shown. */
  save() {
    const rows = this.panels.flatMap((panel) => {
      const time = panel.time === null ? "" : new Date(panel.time).toISOString();
      const state = panel.isStale ? "stale" : "current";
      return panel.records().map(([name, area, address, type, order, value, unit, error]) =>
        [time, panel.part.title, name, area, address, type, order, value, unit, state, error || (panel.error ? panel.error.message : "")]);
    });
    save(`values-${stamp()}.csv`, [CSV, ...rows]);
  }

  /** Stops reading and watching. The last values stay visible. */
  stop() {
    this.reading?.request.abort();
    this.reading = null;
    if (!this.watching) return;
    this.watching.request.abort();
    this.watching = null;
    this.heard = null;
    this.plotted = this.plots?.keys() ?? this.plotted;
    this.span = this.plots ? String(this.plots.span) : this.span;
    this.plots?.stop();
    this.pressed(false);
    this.panels.forEach((panel) => panel.stale("No longer watched."));
    pageUrl.putStopped(); // At once: a reload now must not watch again.
    this.remember();
    say($("outcome"), "Stopped.");
  }

  pressed(is) {
    $("watch").setAttribute("aria-pressed", is);
    $("watch").textContent = is ? "Stop" : "Watch";
  }
}

/** Rounds a quantity down to whole values, at least one. */
const whole = (quantity, width) => Math.max(width, Math.floor(quantity / width) * width);
