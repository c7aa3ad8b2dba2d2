// Formats registers and addresses, and parses what people type. The gateway converts registers to values.

import { MAX_WORD, TYPES } from "./standard.js";

export const hex = (register) => register.toString(16).toUpperCase().padStart(4, "0");
export const binary = (register) => register.toString(2).padStart(16, "0").replace(/(....)(?=.)/g, "$1 ");

/** Returns a type. `size` is the bit number, or the number of bytes; `width` is in registers. */
export function typeOf(kind, size) {
  const ofBytes = kind === "string" || kind === "bytes";
  const width = ofBytes ? Math.ceil(size / 2) : kind === "bit" ? 1 : TYPES[kind].width;
  const name = ofBytes || kind === "bit" ? `${kind}:${size}` : kind;
  return { name, kind, size, width, bytes: ofBytes ? size : 2 * width };
}

/** Returns the error in a byte order of eight letters; "" if it is valid for the type. */
export function flaw(letters, type) {
  const wire = [...letters];
  if (wire.toSorted().join("") !== "ABCDEFGH") return "A byte order of eight letters contains each of A to H once.";
  if (type.bytes !== 8) return `Eight letters are only for values of eight bytes; ${type.name} has ${type.bytes}.`;
  const from = wire.map((letter) => letter.charCodeAt(0) - 65);
  if (from.some((byte, at) => at % 2 === 0 && byte >> 1 !== from[at + 1] >> 1)) return "The bytes of a register stay together: AB, CD, EF and GH.";
  if (from.some((byte, at) => from[byte] !== at)) return "A byte order applied twice must give ABCDEFGH; this one does not.";
  return "";
}

const DIGITS = { 1: "0", 2: "1", 3: "4", 4: "3" };

/** Formats an address in Modicon notation: 40001 is holding register 0. */
export const modicon = (area, address) =>
  DIGITS[area] + String(address + 1).padStart(address > 9998 ? 5 : 4, "0");

/** What can be typed for a register. */
export const REGISTER_FORMS = `0 to ${MAX_WORD}, 0x0000 to 0x${hex(MAX_WORD)}, or bits such as 0b1010`;

/** Parses a register: decimal, 0x or 0b. Throws an error for other text. */
export function register(text) {
  const plain = text.trim().replaceAll("_", "");
  const form = /^(\d{1,5}|0[xX][0-9a-fA-F]{1,4}|0[bB][01]{1,16})$/;
  const value = form.test(plain) ? Number(plain) : NaN;
  if (!(value <= MAX_WORD)) {
    const negative = /^[-−]/.test(plain) ? ". For negative values, choose the type int16" : "";
    throw new Error(`“${text.trim()}” is not a register value: ${REGISTER_FORMS}${negative}`);
  }
  return value;
}

/** Parses a bit. Throws an error for other text. */
export function bit(text) {
  const word = text.trim().toLowerCase();
  if (["1", "on", "true"].includes(word)) return true;
  if (["0", "off", "false"].includes(word)) return false;
  throw new Error(`“${text.trim()}” is not a bit: 0, 1, on or off`);
}

/**
 * Splits values. Throws an error for a comma that may be a decimal comma, or one between thousands: between two digits,
 * but not behind a word such as 0x1.
 */
export function separated(text) {
  const words = text.match(/[^\s;]+/g) ?? [];
  const doubtful = words.find((word) => word.replace(/0(x[\da-f]+|b[01]+),/gi, "").match(/\d,\d/));
  if (doubtful === undefined) return text.split(/[;,]/);
  const isOne = /^(?![+-]?[1-9]\d{0,2},\d{3}$)[+-]?\d+,\d+([eE][-+]?\d+)?$/.test(doubtful);
  const advice = isOne ? `Write ${doubtful.replace(",", ".")} for one value, or ${doubtful.replace(",", "; ")} for two`
    : "Write a decimal point, nothing between thousands, and semicolons between values";
  throw new Error(`“${doubtful}” has ${isOne ? "a decimal comma" : "a comma between digits"}. ${advice}.`);
}

/** Parses a value of a type. Returns its JSON. Throws an error for other text. */
export function literal(text, type) {
  if (type.kind === "string") return characters(text, type);
  if (type.kind === "bytes") return octets(text, type);
  if (type.kind === "bool" || type.kind === "bit") return String(bit(text));
  return type.kind === "uint16" ? String(register(text)) : numeral(text, type.name);
}

function characters(text, type) {
  if (!/^[\x00-\x7f]*$/.test(text) || text.length > type.size) {
    throw new Error(`“${text}” is not a valid ${type.name}: up to ${type.size} ASCII characters`);
  }
  return JSON.stringify(text);
}

function octets(text, type) {
  const plain = text.replace(/\s/g, "").toLowerCase();
  if (!/^([0-9a-f]{2})*$/.test(plain) || plain.length !== 2 * type.size) {
    throw new Error(`“${text.trim()}” is not a valid ${type.name}: ${type.size} pairs of hexadecimal digits`);
  }
  return JSON.stringify(plain);
}

/** What a number becomes in the registers of a floating-point type. */
const ROUNDINGS = {
  float16: (number) => rounded(number, 10, -14),
  float32: Math.fround,
  float64: (number) => number,
};

/** Returns the range of a numeric type as text, or "" for other types. */
export function extent(kind) {
  const ends = TYPES[kind]?.ends ?? [];
  return (kind in ROUNDINGS ? ends.map((end) => end.toPrecision(6)) : ends).join(" to ").replace("-", "−");
}

/** Rounds a number to a significand of some bits, as `Math.fround` does. */
function rounded(number, bits, least) {
  if (number === 0) return number;
  const step = 2 ** (Math.max(Math.floor(Math.log2(Math.abs(number))), least) - bits);
  const [down, rest] = [Math.floor(number / step), number / step - Math.floor(number / step)];
  return step * (down + Number(rest > 0.5 || (rest === 0.5 && down % 2 !== 0)));
}

/** Parses a number of a floating-point type. In JSON, `-0` is an integer, which has no sign of zero. */
function floating(text, plain, type) {
  const found = ROUNDINGS[type](Number(plain));
  if (!(Math.abs(found) <= TYPES[type].ends[1])) throw new Error(`“${text.trim()}” does not fit ${type}: ${extent(type)}`);
  if (found === 0 && /[1-9]/.test(plain.split(/e/i)[0])) throw new Error(`“${text.trim()}” is too small for ${type}, which would be 0`);
  return plain === "-0" ? "-0.0" : plain;
}

/** Parses a number of a type. Returns JSON text with the same digits. Throws an error for other text. */
export function numeral(text, type) {
  const plain = text.trim().replace(/^\+/, "");
  const isFloat = type in ROUNDINGS;
  if (isFloat && /^-?(0|[1-9]\d*)(\.\d+)?([eE][-+]?\d+)?$/.test(plain)) return floating(text, plain, type);
  if (!isFloat && /^-?(0|[1-9]\d{0,19})$/.test(plain)) {
    const [least, most] = TYPES[type].ends.map(BigInt);
    if (BigInt(plain) >= least && BigInt(plain) <= most) return plain;
  }
  throw new Error(`“${text.trim()}” is not a valid ${type}: ${extent(type)}`);
}

/** Returns the text of a number, if it has one: numbers of 64 bits have more digits in their text. */
export const digits = (number, text) => (text && Number(text) === number ? text : String(number));

/** Returns whether a byte order swaps the bytes of each register. */
export const swapsBytes = (order) => ["BADC", "DCBA"].includes(order);
