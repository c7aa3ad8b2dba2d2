// A write: the values that are typed, the request that sends them, and the registers or coils that it changes.

import { answer, post, Problem, sendJson } from "./api.js";
import { bit, literal, register, separated, swapsBytes } from "./numbers.js";
import { same } from "./parts.js";
import { areaOf, MAX_WORD } from "./standard.js";
import { stream } from "./streams.js";

/** Returns whether the values of a range are the registers as they are. */
export const isPlain = ({ type, order }) => type.kind === "uint16" && !swapsBytes(order);

/** What a write does to consecutive registers or coils. */
class Change {
  /**
   * `words` are the new registers, or booleans for coils. `mask` is given instead for some bits of one
   * register: the AND and the OR mask. `values` are the names and the new texts of typed values.
   */
  constructor(target, { words = null, mask = null, values = [], typed = {} }) {
    const { part, tag, area, address, ofBits } = target;
    const { device, source } = part;
    Object.assign(this, { device, source, tag, area, address, ofBits, words, mask, values, typed });
    this.count = mask ? 1 : words.length;
  }

  /** Returns the words after the write. One that depends on an unknown word is null. */
  after(before) {
    if (!this.mask) return this.words;
    const [and, or] = this.mask;
    return [before === null ? null : (before[0] & and) | (or & ~and & MAX_WORD)];
  }

  /** Returns whether words that were read back are those after the write. */
  isIn(words) {
    return same(this.after(words), words);
  }

  /** Returns the path and the body of the request. */
  request() {
    const { device, address, ofBits, words, mask } = this;
    const about = { ...device, address };
    if (mask) return ["/api/modbus/write/mask", { ...about, andMask: mask[0], orMask: mask[1] }];
    const one = ofBits ? "coil" : "register";
    return words.length === 1
      ? [`/api/modbus/write/${one}`, { ...about, value: words[0] }]
      : [`/api/modbus/write/${one}s`, { ...about, values: words }];
  }

  /**
   * Reads what the device has now: the words, the texts of the typed values, and the time: `at` by the clock of the
   * gateway, as in the tables, and `time` by that of the browser.
   */
  async read(signal) {
    const found = await (this.tag ? this.readTag(signal) : this.readRange(signal));
    return { ...found, time: Date.now() };
  }

  range() {
    return { functionCode: this.area, address: this.address, quantity: this.count };
  }

  async readRange(signal) {
    const body = { ...this.device, ...this.range(), ...this.typed };
    const reply = await sendJson("/api/modbus/read", body, { signal, extraTime: this.device.timeout });
    const { values, typedText = [] } = await answer(reply);
    return { words: values, texts: typedText, at: Date.parse(reply.headers.get("Date")) };
  }

  /** Reads the value of a tag, which may be scaled by a register, and its words. */
  async readTag(signal) {
    const parts = [{ ...this.source, only: [this.tag.name] }, this.range()];
    const body = { ...this.device, parts, once: true };
    let found = null;
    const extraTime = parts.length * this.device.timeout;
    await stream("/api/modbus/watch/view", body, { signal, extraTime }, (_, data) => (found = data));
    if (found === null) throw new Problem("gateway_gone", "the gateway sent no value");
    const [own, words] = found.parts;
    checkDefinition(this.tag, own.tags[0]);
    if (words.error) throw new Problem(words.reason, words.error, words.code);
    return { words: words.values, texts: [own.error ?? own.errors[0] ?? own.texts[0]], at: found.time };
  }
}

/** Lets the gateway check values. Errors in what was typed have only its message. */
async function checked(path, body) {
  try {
    return await post(path, body);
  } catch (error) {
    throw error.reason === "malformed" ? new Error(error.message) : error;
  }
}

/** Throws an error if the gateway has another definition of a tag than the one that is shown. */
function checkDefinition(shown, found) {
  if (!same(found, shown)) throw new Error(`The gateway has another definition of ${shown.name} now. Close this dialog and read the values again.`);
}

/** Returns the change that writes the value of a tag, which the gateway scales. */
export async function ofTag(target, text) {
  const { part, tag } = target;
  const found = await checked("/api/gateway/tags/value", { ...part.source, name: tag.name, value: text });
  checkDefinition(tag, found.tag);
  const values = [{ name: tag.name, text: found.text }];
  return new Change(target, found.form === "mask" ? { mask: found.values, values } : { words: found.values, values });
}

/** Returns the change that writes coils or registers. */
export function ofWords(target, text) {
  // Bits have no decimals, so a comma between them separates.
  const words = target.ofBits ? text.split(/[;,]/).map(bit) : separated(text).map(register);
  limited(words.length, target);
  return new Change(target, { words });
}

/** Returns the change that writes values of the type of a range. */
export async function ofType(target, text) {
  const { part: { type, order }, address } = target;
  const parts = type.kind === "string" ? [text] : type.kind === "bytes" ? text.split(/[;,]/) : separated(text);
  if (type.kind === "bit" && parts.length > 1) throw new Error("Write one bit at a time");
  const literals = parts.map((each) => literal(each, type));
  limited(literals.length * type.width, target);
  const typed = { datatype: type.name, byteOrder: order };
  if (type.kind === "bit") return ofBit(target, literals[0], typed);
  // Not with `JSON.stringify`: the digits of a number stay as they were typed.
  const body = `${JSON.stringify(typed).slice(0, -1)},"values":[${literals.join()}]}`;
  const { values: words, typedText } = await checked("/api/gateway/values", body);
  const values = typedText.map((each, at) => ({ name: String(address + at * type.width), text: each }));
  return new Change(target, { words, values, typed });
}

function ofBit(target, literal, typed) {
  const { part: { type, order }, address } = target;
  const bits = 1 << (type.size ^ (swapsBytes(order) ? 8 : 0));
  const mask = [MAX_WORD ^ bits, literal === "true" ? bits : 0];
  return new Change(target, { mask, values: [{ name: String(address), text: literal }], typed });
}

function limited(count, { area, ofBits }) {
  const { mostWritten } = areaOf(area);
  const what = ofBits ? "coils" : "registers";
  if (count > mostWritten) throw new Error(`too many values: ${count} ${what}, at most ${mostWritten} in one write`);
}
