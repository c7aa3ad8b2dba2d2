// The values view: reads or watches a range, and offers plots and writes.

import { notice, post, stream } from "./api.js";
import { $, h, say, show } from "./dom.js";
import { flaw, modicon, typeOf } from "./numbers.js";
import { Plots } from "./plots.js";
import { areaOf, LAST } from "./standard.js";
import { Table } from "./table.js";
import { Writer } from "./writing.js";

const RESUME = 1000;
const WRITTEN = { written: "Written", refused: "Not written", unknown: "Unknown whether it was written" };
/** Errors after which a watch does not retry. */
const FINAL = new Set(["malformed", "refused_target", "unauthorized", "foreign_page", "not_found"]);

/** The values view. `may.write` is whether the gateway allows writes. */
export class Values {
  constructor(may) {
    this.may = may;
    this.writer = new Writer();
    this.device = this.table = this.plots = this.watching = this.reading = null;
    $("range").addEventListener("submit", (event) => {
      event.preventDefault();
      this.read();
    });
    $("range").addEventListener("input", () => this.adapt());
    $("type").addEventListener("change", () => {
      $("size").value = $("type").value === "bit" ? 0 : 20;
      this.adapt();
    });
    $("watch").addEventListener("click", () => {
      if (this.watching) this.stop();
      else if ($("range").reportValidity()) this.watch(this.range());
    });
    this.adapt();
  }

  /** Selects a device, and removes the values of the previous one. */
  use(device) {
    this.device = device;
    this.plots?.end();
    this.table = this.plots = null;
    $("table").replaceChildren(h("p", { class: "card empty" }, "Choose a range, then read or watch it."));
    say($("outcome"));
  }

  /** Deselects the device. The last values stay visible, marked as stale. */
  leave() {
    this.stop();
    this.device = null;
    this.table?.stale(true);
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
    const past = address + whole(Number($("quantity").value), this.type().width) > LAST + 1;
    $("quantity").setCustomValidity(past ? `The last address is ${LAST}: at most ${LAST + 1 - address} from ${address}.` : "");
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
    this.read(length > most ? `The range has ${length.toLocaleString("en")} addresses; one read covers only a part of it.` : null);
  }

  /** Returns the range of the form, with the quantity rounded to whole values of the type. */
  range() {
    const area = Number($("area").value);
    const address = Number($("address").value);
    const type = this.type();
    const asked = Number($("quantity").value);
    const quantity = whole(asked, type.width);
    $("quantity").value = quantity;
    return {
      device: this.device,
      area, address, quantity, type,
      ofBits: area < 3,
      width: type.width,
      order: this.order(),
      title: `${areaOf(area).title} ${address} to ${address + quantity - 1}`,
      note: asked === quantity ? null : `Each ${type.name} has ${type.width} registers: ${quantity} instead of ${asked}.`,
    };
  }

  /** Converts a range to the fields of a request. */
  request(range) {
    const { device, area, address, quantity, ofBits, type, order } = range;
    const typed = ofBits ? {} : { datatype: type.name, byteOrder: order };
    return { ...device, functionCode: area, address, quantity, ...typed };
  }

  async read(more = null) {
    this.stop();
    const range = this.range();
    const reading = new AbortController();
    this.reading = reading;
    say($("outcome"), "Reading…");
    try {
      const began = performance.now();
      const found = await post("/api/modbus/read", this.request(range), reading.signal);
      if (this.reading !== reading) return;
      this.show(range).set(found.values, found.typedText);
      say($("outcome"), `${range.title}: read in ${Math.round(performance.now() - began)} ms.`, range.note, more);
    } catch (error) {
      if (this.reading !== reading) return;
      this.table?.stale(true);
      say($("outcome"), notice(error), range.note);
    }
    this.reading = null;
  }

  show(range) {
    this.plots?.end();
    this.plots = null;
    const writable = this.may.write && (range.area === 1 || range.area === 3);
    this.table = new Table($("table"), range, {
      write: writable ? (address) => this.write(range, address) : null,
      plot: (address) => this.plot(address),
    });
    $("only-reads").hidden = this.may.write;
    return this.table;
  }

  async write(range, address) {
    const outcome = await this.writer.ask(range, address);
    if (outcome === null) return;
    const told = WRITTEN[outcome];
    if (this.table?.range !== range || this.device !== range.device) {
      say($("outcome"), `${told}: address ${address} of ${range.device.host}:${range.device.port}.`);
      return;
    }
    if (this.watching) {
      say($("outcome"), `${told}. The watch continues.`);
      return;
    }
    try {
      const found = await post("/api/modbus/read", this.request(range));
      if (this.table?.range !== range || this.device !== range.device) return;
      this.table.set(found.values, found.typedText, true);
      const changed = `${told} and read back. Changes are marked.`;
      say($("outcome"), outcome === "written" ? changed : `${told}. The table shows the values read back.`);
    } catch (error) {
      if (this.table?.range !== range) return;
      this.table.stale(true);
      say($("outcome"), notice(error, `${told}. Reading back failed.`));
    }
  }

  /** Adds or removes the plot of an address. Starts a watch if necessary. */
  plot(address) {
    if (!this.watching) {
      if (!$("interval").reportValidity()) return;
      this.watch(this.table.range);
    }
    this.wanted = address;
    this.plots?.choose(address);
  }

  /** Watches a range until it is stopped. Retries when the stream ends. */
  async watch(range) {
    this.stop();
    const stopping = new AbortController();
    this.watching = stopping;
    this.wanted = null;
    this.interval = $("interval").value;
    this.plots?.end();
    this.plots = null;
    this.pressed(true);
    say($("outcome"), "Reading…");
    const { unitId, ...rest } = this.request(range);
    const query = new URLSearchParams({ ...rest, unitId, interval: this.interval });
    let began = false;
    let told = null;
    while (this.watching === stopping) {
      try {
        await stream(`/api/modbus/watch?${query}`, { signal: stopping.signal }, (name, data) => {
          if (this.watching !== stopping) return;
          [began, told] = [true, null];
          this.happened(range, name, data);
        });
        if (this.watching === stopping) told = this.interrupted(null, told);
      } catch (error) {
        if (this.watching !== stopping) return;
        if (!began || FINAL.has(error.reason)) {
          this.stop();
          this.table?.stale(true);
          say($("outcome"), notice(error));
          return;
        }
        told = this.interrupted(error, told);
      }
      await new Promise((resolve) => setTimeout(resolve, RESUME));
    }
  }

  /** Handles an interrupted watch. Shows each reason once. */
  interrupted(error, told) {
    const reason = error?.reason ?? "ended";
    this.table?.stale(true);
    const gone = ["ended", "gateway_gone"];
    if (reason === told || (gone.includes(reason) && gone.includes(told))) return told;
    const goes = "The watch resumes automatically. Press Stop to end it.";
    if (gone.includes(reason)) say($("outcome"), "The gateway ended the watch or does not answer. The watch resumes automatically when the gateway is back. Press Stop to end it.");
    else say($("outcome"), notice(error), goes);
    return reason;
  }

  happened(range, name, data) {
    if (name === "problem") {
      this.table?.stale(true);
      const problem = Object.assign(new Error(data.error), { reason: data.reason });
      say($("outcome"), notice(problem), "Retrying…");
    } else if (name === "values") {
      this.begin(range, data);
    } else {
      for (const { address, value } of data.changes) this.table.put(address - range.address, value);
      for (const { index, text } of data.typed ?? []) this.table.putTyped(index, text);
      const starts = (data.typed ?? []).map(({ index }) => range.address + index * range.width);
      const bare = data.changes.map((each) => each.address);
      for (const address of range.ofBits ? bare : new Set([...starts, ...bare.filter((each) => this.plots.shown.has(each))])) {
        this.plots.changed(address);
      }
    }
  }

  begin(range, data) {
    if (this.table?.range !== range) this.show(range);
    this.table.set(data.values, data.typedText, true);
    this.plots ??= new Plots(range, (address) => this.table.number(address - range.address));
    if (this.wanted !== null) this.plots.choose(this.wanted);
    this.wanted = null;
    say($("outcome"), `Watching ${range.title.toLowerCase()}, every ${this.interval} ms.`, range.note);
  }

  /** Stops reading and watching. The last values stay visible. */
  stop() {
    this.reading?.abort();
    this.reading = null;
    if (!this.watching) return;
    this.watching.abort();
    this.watching = null;
    this.plots?.stop();
    this.pressed(false);
    say($("outcome"), "Stopped.");
  }

  pressed(is) {
    $("watch").setAttribute("aria-pressed", is);
    $("watch").textContent = is ? "Stop" : "Watch";
  }
}

/** Rounds a quantity down to whole values, at least one. */
const whole = (quantity, width) => Math.max(width, Math.floor(quantity / width) * width);
