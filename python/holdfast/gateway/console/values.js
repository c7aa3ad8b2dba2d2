// Reading a range, once or again and again, and what can be done with what is there.

import { notice, post, stream } from "./api.js";
import { $, say } from "./dom.js";
import { modicon, WIDTHS } from "./numbers.js";
import { Plots } from "./plots.js";
import { Table } from "./table.js";
import { Writer } from "./writing.js";

const AREAS = { 1: "Coils", 2: "Discrete inputs", 3: "Holding registers", 4: "Input registers" };

/** The view of values of the device that `target()` is; `may.write` says whether it may change. */
export class Values {
  constructor(target, may) {
    this.target = target;
    this.may = may;
    this.writer = new Writer(target);
    this.table = this.plots = this.watching = null;
    $("range").addEventListener("submit", (event) => {
      event.preventDefault();
      this.read();
    });
    $("range").addEventListener("input", () => this.adapt());
    $("watch").addEventListener("click", () => (this.watching ? this.stop() : this.watch()));
    this.adapt();
  }

  /** Makes the fields those of the area. */
  adapt() {
    const area = Number($("area").value);
    const ofBits = area < 3;
    for (const id of ["type", "order"]) $(id).closest("label").hidden = ofBits;
    $("quantity").max = ofBits ? 2000 : 125;
    const address = Number($("address").value);
    $("modicon").textContent = Number.isInteger(address) && address >= 0 ? `= ${modicon(area, address)}` : "";
  }

  /** Shows a range that was chosen elsewhere. */
  open(area, address, quantity) {
    $("area").value = area;
    $("address").value = address;
    $("quantity").value = quantity;
    this.adapt();
    return this.read();
  }

  /** What the form asks for; a type takes whole values. */
  range() {
    const area = Number($("area").value);
    const ofBits = area < 3;
    const type = ofBits ? "bool" : $("type").value;
    let quantity = Number($("quantity").value);
    const width = type === "string" ? quantity : (WIDTHS[type] ?? 1);
    quantity = Math.min(Math.ceil(quantity / width) * width, Math.floor((ofBits ? 2000 : 125) / width) * width);
    $("quantity").value = quantity;
    const address = Number($("address").value);
    return {
      area, address, quantity, ofBits, width,
      type: type === "string" ? "text" : type,
      order: $("order").value,
      title: `${AREAS[area]} ${address} to ${address + quantity - 1}`,
    };
  }

  /** The range as the gateway wants it. */
  request(range) {
    const { area, address, quantity, ofBits, type, order } = range;
    const typed = ofBits ? {} : { datatype: type === "text" ? `string:${2 * quantity}` : type, byteOrder: order };
    return { ...this.target(), functionCode: area, address, quantity, ...typed };
  }

  async read() {
    this.stop();
    const range = this.range();
    $("read").disabled = true;
    try {
      const began = performance.now();
      const found = await post("/api/modbus/read", this.request(range));
      this.show(range).set(found.values, found.typedText);
      say($("outcome"), `${range.title}: read in ${Math.round(performance.now() - began)} ms.`);
    } catch (error) {
      this.table?.stale(true);
      say($("outcome"), notice(error));
    } finally {
      $("read").disabled = false;
    }
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
    if (!(await this.writer.ask(range, address)) || this.watching) return;
    const found = await post("/api/modbus/read", this.request(range)).catch(() => null);
    if (!found || this.table.range !== range) return;
    this.table.set(found.values, found.typedText, true);
    say($("outcome"), `Written, and read back: what has changed is marked.`);
  }

  plot(address) {
    if (!this.watching) this.watch();
    this.wanted = address;
    this.plots?.choose(address);
  }

  async watch() {
    const range = this.range();
    const stopping = new AbortController();
    this.watching = stopping;
    this.wanted = null;
    this.pressed(true);
    const { unitId, ...rest } = this.request(range);
    const query = new URLSearchParams({ ...rest, unitId, interval: $("interval").value });
    try {
      await stream(`/api/modbus/watch?${query}`, { signal: stopping.signal }, (name, data) => {
        if (this.watching === stopping) this.happened(range, name, data);
      });
      if (this.watching === stopping) say($("outcome"), "The gateway has ended the watch.");
    } catch (error) {
      if (this.watching === stopping) say($("outcome"), notice(error));
    }
    if (this.watching === stopping) this.stop();
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
    this.plots ??= new Plots((address) => this.table.number(address - range.address));
    if (this.wanted !== null) this.plots.choose(this.wanted);
    this.wanted = null;
    say($("outcome"), `Watching ${range.title.toLowerCase()}, every ${$("interval").value} ms.`);
  }

  /** Ends watching; what was seen last stays. */
  stop() {
    if (!this.watching) return;
    this.watching.abort();
    this.watching = null;
    this.plots?.stop();
    this.pressed(false);
    if ($("outcome").textContent.startsWith("Watching")) say($("outcome"), "Stopped.");
  }

  pressed(is) {
    $("watch").setAttribute("aria-pressed", is);
    $("watch").textContent = is ? "Stop" : "Watch";
  }
}
