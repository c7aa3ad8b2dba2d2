// Reading a range, once or again and again, and what can be done with what is there.

import { notice, post, stream } from "./api.js";
import { $, h, say, show } from "./dom.js";
import { flaw, modicon, typeOf } from "./numbers.js";
import { Plots } from "./plots.js";
import { areaOf, LAST } from "./standard.js";
import { Table } from "./table.js";
import { Writer } from "./writing.js";

const RESUME = 1000;
const WRITTEN = { written: "Written", refused: "Not written", unknown: "Not known whether it was written" };
/** Problems that waiting for the gateway does not solve. */
const FINAL = new Set(["malformed", "refused_target", "unauthorized", "foreign_page", "not_found"]);

/** The view of values of a device; `may.write` says whether it may change. */
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

  /** Takes a device to work on; what was shown goes. */
  use(device) {
    this.device = device;
    this.plots?.end();
    this.table = this.plots = null;
    $("table").replaceChildren(h("p", { class: "card empty" }, "Choose a range, then read it once, or watch it."));
    say($("outcome"));
  }

  /** There is no device; what was read last stays, as old. */
  leave() {
    this.stop();
    this.device = null;
    this.table?.stale(true);
  }

  /** Makes the fields those of the area and the type, and says which don't go together. */
  adapt() {
    const area = Number($("area").value);
    const ofBits = area < 3;
    const kind = $("type").value;
    const ofLetters = !ofBits && $("order").value === "letters";
    for (const id of ["type", "order"]) show($(id), !ofBits);
    show($("letters"), ofLetters);
    show($("size"), !ofBits && ["bit", "string", "bytes"].includes(kind));
    $("size-name").textContent = kind === "bit" ? "Which bit" : "Bytes each";
    [$("size").min, $("size").max] = kind === "bit" ? [0, 15] : [1, 250];
    $("quantity").max = areaOf(area).most;
    const address = Number($("address").value);
    $("modicon").textContent = Number.isInteger(address) && address >= 0 ? `= ${modicon(area, address)}` : "";
    const past = address + whole(Number($("quantity").value), this.type().width) > LAST + 1;
    $("quantity").setCustomValidity(past ? `The last address is ${LAST}: from ${address} there are ${LAST + 1 - address}.` : "");
    $("letters").setCustomValidity(ofLetters ? flaw(this.order(), this.type()) : "");
  }

  type() {
    return Number($("area").value) < 3 ? typeOf("bool") : typeOf($("type").value, Number($("size").value));
  }

  order() {
    return $("order").value === "letters" ? $("letters").value.trim().toUpperCase() : $("order").value;
  }

  /** Shows a range that was chosen elsewhere: all of it, as far as one read goes. */
  open(area, address, length) {
    $("area").value = area;
    $("address").value = address;
    this.adapt();
    const most = Number($("quantity").max);
    if (length <= most && length % this.type().width > 0) $("type").value = "uint16";
    $("quantity").value = whole(Math.min(length, most), this.type().width);
    this.adapt();
    this.read(length > most ? `The range has ${length.toLocaleString("en")}, which one read does not take.` : null);
  }

  /** What the form asks for: whole values of the type. */
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
      note: asked === quantity ? null : `Each ${type.name} takes ${type.width} registers: ${quantity} rather than ${asked}.`,
    };
  }

  /** The range as the gateway wants it. */
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
      say($("outcome"), `${told}. Watching goes on.`);
      return;
    }
    try {
      const found = await post("/api/modbus/read", this.request(range));
      if (this.table?.range !== range || this.device !== range.device) return;
      this.table.set(found.values, found.typedText, true);
      const changed = `${told}, and read back: what has changed is marked.`;
      say($("outcome"), outcome === "written" ? changed : `${told}. Read back: this is what is there.`);
    } catch (error) {
      if (this.table?.range !== range) return;
      this.table.stale(true);
      say($("outcome"), notice(error, `${told}. It could not be read back.`));
    }
  }

  /** The plot of an address of the table, whose range is watched for that. */
  plot(address) {
    if (!this.watching) {
      if (!$("interval").reportValidity()) return;
      this.watch(this.table.range);
    }
    this.wanted = address;
    this.plots?.choose(address);
  }

  /** Polls a range until it is stopped; begins again when the gateway was gone. */
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

  /** There is nothing to watch for now; says it once. */
  interrupted(error, told) {
    const reason = error?.reason ?? "ended";
    this.table?.stale(true);
    const gone = ["ended", "gateway_gone"];
    if (reason === told || (gone.includes(reason) && gone.includes(told))) return told;
    const goes = "It goes on by itself when that is over; Stop ends it.";
    if (gone.includes(reason)) say($("outcome"), "The gateway has ended the watch, or is gone. It goes on by itself when the gateway is back; Stop ends it.");
    else say($("outcome"), notice(error), goes);
    return reason;
  }

  happened(range, name, data) {
    if (name === "problem") {
      this.table?.stale(true);
      const problem = Object.assign(new Error(data.error), { reason: data.reason });
      say($("outcome"), notice(problem), "Trying again and again…");
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

  /** Ends reading and watching; what was seen last stays. */
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

/** As many registers as hold whole values, but one at least. */
const whole = (quantity, width) => Math.max(width, Math.floor(quantity / width) * width);
