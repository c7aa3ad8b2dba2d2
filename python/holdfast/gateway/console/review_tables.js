// The review of a write: each register or coil that it changes, before and after.

import { notice } from "./api.js";
import { $, clock, h, table } from "./dom.js";
import { binary, hex } from "./numbers.js";

const UNREAD = "not read";

/** Shows what a change does. `before` has what was read, or the error of the read. */
export function show(change, before) {
  const words = before.words ?? null;
  const after = change.after(words);
  showHeading(change, before);
  $("write-unread").replaceChildren(before.error ? notice(before.error) : "");
  const detail = words !== null && !change.ofBits && change.count === 1 && change.values.length === 0;
  $("write-tables").replaceChildren(
    ...(change.values.length > 0 ? [valueTable(change, before.texts ?? [])] : []),
    wordTable(change, words, after),
    ...(detail ? [bitTable(words[0], after[0])] : []),
  );
}

/** Says what is written, and how old the review is. */
export function showHeading(change, before) {
  $("write-what").replaceChildren(h("strong", {}, writtenText(change)), " ", h("span", { class: "dim" }, readText(change, before)));
}

/** Clears the review. */
export function clear() {
  for (const id of ["write-what", "write-unread", "write-tables"]) $(id).replaceChildren();
}

/** Returns a word as text: `on`, or `1234 0x04D2`. */
export function inWords(word) {
  if (typeof word === "boolean") return word ? "on" : "off";
  return `${word} 0x${hex(word)}`;
}

/** Says how many addresses are written, and which. */
function writtenText({ ofBits, mask, address, count }) {
  const noun = `${ofBits ? "coil" : "register"}${count === 1 ? "" : "s"}`;
  const where = count === 1 ? address : `${address}-${address + count - 1}`;
  const only = mask ? ` Only ${ofMask(mask)} is written.` : "";
  return `Writes ${count} ${noun}: ${where}.${only}`;
}

/** Says when the current values were read, or that they can't be. */
function readText({ count }, { at, error }) {
  const [current, were, they] = count === 1 ? ["The current value", "was", "It"] : ["The current values", "were", "They"];
  return error ? `${current} can't be read. ${they} can still be overwritten.` : `${current} ${were} read at ${clock(at)}.`;
}

/** Names the bit of a mask. The console writes masks of one bit only. */
const ofMask = ([and]) => `bit ${Math.log2(and ^ 0xffff)}`;

function valueTable({ tag, values, typed }, texts) {
  const caption = tag ? tag.type : `${typed.datatype}, byte order ${typed.byteOrder}`;
  const rows = values.map(({ name, text }, at) => [name, texts[at] ?? UNREAD, text]);
  return table("review by-column", h("caption", {}, caption), [tag ? "Tag" : "Address", "Now", "New"], rows);
}

function wordTable({ ofBits, address, mask }, before, after) {
  const rows = after.map((word, at) => {
    const now = before === null ? UNREAD : inWords(before[at]);
    const next = word === null ? `${ofMask(mask)} ${mask[1] ? "on" : "off"}` : inWords(word);
    const differs = before !== null && before[at] !== word;
    return [String(address + at), now, differs ? h("mark", {}, next) : next];
  });
  const [one, many] = ofBits ? ["Coil", "Coils"] : ["Register", "Registers"];
  return table("review by-column", named(many), [one, "Now", "New"], rows);
}

/** Shows one register in every form. Changed bits are marked. */
function bitTable(before, after) {
  const [was, will] = [binary(before), binary(after)];
  const marked = [...will].map((bit, at) => (bit === was[at] ? bit : h("mark", {}, bit)));
  const head = [h("span", { class: "unseen" }, "When"), "Decimal", "Hex", "Binary"];
  return table("review by-row", named("Bits"), head, [["Now", String(before), hex(before), was], ["New", String(after), hex(after), marked]]);
}

/** Names a table for screen readers. */
const named = (text) => h("caption", { class: "unseen" }, text);
