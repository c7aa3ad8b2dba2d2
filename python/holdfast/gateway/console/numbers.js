// Converts registers to numbers and text, and parses what people type.

export const hex = (register) => register.toString(16).toUpperCase().padStart(4, "0");
export const binary = (register) => register.toString(2).padStart(16, "0").replace(/(....)(?=.)/g, "$1 ");

const WIDTHS = {
  bool: 1, bit: 1,
  int16: 1, uint16: 1, bcd16: 1, float16: 1,
  int32: 2, uint32: 2, bcd32: 2, float32: 2,
  int64: 4, uint64: 4, float64: 4,
};

/** Returns a type. `size` is the bit number, or the number of bytes; `width` is in registers. */
export function typeOf(kind, size) {
  const ofBytes = kind === "string" || kind === "bytes";
  const width = ofBytes ? Math.ceil(size / 2) : WIDTHS[kind];
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
export const REGISTER_FORMS = "0 to 65535, 0x0000 to 0xFFFF, or bits such as 0b1010";

/** Parses a register: decimal, 0x or 0b. Throws an error for other text. */
export function register(text) {
  const plain = text.trim().replaceAll("_", "");
  const form = /^(\d{1,5}|0[xX][0-9a-fA-F]{1,4}|0[bB][01]{1,16})$/;
  const value = form.test(plain) ? Number(plain) : NaN;
  if (!(value <= 65535)) {
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

/** Splits values. Throws an error for a comma that may be a decimal comma. */
export function separated(text) {
  const comma = /(?<![\w.])[+-]?\d+,\d+([eE][-+]?\d+)?/.exec(text);
  if (comma) {
    const [whole] = comma;
    throw new Error(`“${whole}” has a decimal comma. Write ${whole.replace(",", ".")} for one value, or ${whole.replace(",", "; ")} for two.`);
  }
  return text.split(/[;,]/);
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

/** The minimum and the maximum of integer types. */
const EXTENTS = {
  int16: [-(2n ** 15n), 2n ** 15n - 1n], uint16: [0n, 2n ** 16n - 1n], bcd16: [0n, 9999n],
  int32: [-(2n ** 31n), 2n ** 31n - 1n], uint32: [0n, 2n ** 32n - 1n], bcd32: [0n, 99999999n],
  int64: [-(2n ** 63n), 2n ** 63n - 1n], uint64: [0n, 2n ** 64n - 1n],
};

/** The greatest number of floating-point types, and what a number becomes in their registers. */
const FLOATS = {
  float16: [65504, (number) => rounded(number, 10, -14)],
  float32: [3.4028234663852886e38, Math.fround],
  float64: [Number.MAX_VALUE, (number) => number],
};

/** Returns the range of a numeric type as text, or "" for other types. */
export function extent(kind) {
  const most = FLOATS[kind]?.[0].toPrecision(6);
  const ends = EXTENTS[kind] ?? (most ? [`-${most}`, most] : []);
  return ends.join(" to ").replace("-", "−");
}

/** Rounds a number to a significand of some bits, as `Math.fround` does. */
function rounded(number, bits, least) {
  if (number === 0) return number;
  const step = 2 ** (Math.max(Math.floor(Math.log2(Math.abs(number))), least) - bits);
  const [down, rest] = [Math.floor(number / step), number / step - Math.floor(number / step)];
  return step * (down + Number(rest > 0.5 || (rest === 0.5 && down % 2 !== 0)));
}

/** Parses a number of a floating-point type. */
function floating(text, plain, type) {
  const [most, fit] = FLOATS[type];
  const found = fit(Number(plain));
  if (!(Math.abs(found) <= most)) throw new Error(`“${text.trim()}” does not fit ${type}: ${extent(type)}`);
  if (found === 0 && /[1-9]/.test(plain.split(/e/i)[0])) throw new Error(`“${text.trim()}” is too small for ${type}, which would be 0`);
  return plain;
}

/** Parses a number of a type. Returns JSON text with the same digits. Throws an error for other text. */
export function numeral(text, type) {
  const plain = text.trim().replace(/^\+/, "");
  const ends = EXTENTS[type];
  if (!ends && /^-?(0|[1-9]\d*)(\.\d+)?([eE][-+]?\d+)?$/.test(plain)) return floating(text, plain, type);
  if (ends && /^-?(0|[1-9]\d{0,19})$/.test(plain)) {
    const whole = BigInt(plain);
    if (whole >= ends[0] && whole <= ends[1]) return plain;
  }
  throw new Error(`“${text.trim()}” is not a valid ${type}: ${extent(type)}`);
}

const READERS = {
  int16: [2, (view) => view.getInt16(0)],
  uint16: [2, (view) => view.getUint16(0)],
  float16: [2, (view) => Number(half(view.getUint16(0)).toPrecision(4))],
  bcd16: [2, (view) => digits(view.getUint16(0), 4)],
  int32: [4, (view) => view.getInt32(0)],
  uint32: [4, (view) => view.getUint32(0)],
  float32: [4, (view) => Number(view.getFloat32(0).toPrecision(7))],
  bcd32: [4, (view) => digits(view.getUint32(0), 8)],
  int64: [8, (view) => view.getBigInt64(0)],
  uint64: [8, (view) => view.getBigUint64(0)],
  float64: [8, (view) => Number(view.getFloat64(0).toPrecision(12))],
};

function half(bits) {
  const [sign, exponent, fraction] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
}

/** Converts binary coded decimals; "–" for a digit above 9. */
function digits(number, count) {
  const text = number.toString(16).padStart(count, "0");
  return /^\d+$/.test(text) ? Number(text) : "–";
}

const ORDERS = {
  ABCD: (bytes) => bytes,
  CDAB: (bytes) => pairs(bytes).reverse().flat(),
  BADC: (bytes) => pairs(bytes).flatMap(([a, b]) => [b, a]),
  DCBA: (bytes) => [...bytes].reverse(),
};

/** Returns whether a byte order swaps the bytes of each register. */
export const swapsBytes = (order) => ["BADC", "DCBA"].includes(order);

const SPELLED = ["CDABGHEF", "EFGHABCD", "FEHGBADC", "DCBAHGFE"];

const pairs = (bytes) => bytes.filter((_, at) => at % 2 === 0).map((byte, at) => [byte, bytes[2 * at + 1]]);
const spelled = (letters) => (bytes) => [...letters].map((letter) => bytes[letter.charCodeAt(0) - 65]);

function rows(bytes, arrangements, fits) {
  return Object.entries(READERS).filter(([, [size]]) => fits(size) && size <= bytes.length).map(([type, [size, read]]) => {
    const own = bytes.slice(0, size);
    return [type, arrangements.map((arrange) => String(read(new DataView(Uint8Array.from(arrange(own)).buffer))))];
  });
}

/** Lists the bits of a register that are on: "0 3–5", or "none". */
function bitsOn(register) {
  const runs = [];
  for (let at = 0; at < 16; at += 1) {
    if (!(register & (1 << at))) continue;
    if (runs.at(-1)?.[1] === at - 1) runs.at(-1)[1] = at;
    else runs.push([at, at]);
  }
  return runs.map(([from, to]) => (from === to ? from : `${from}–${to}`)).join(" ") || "none";
}

/** Converts registers to every type and byte order. Returns tables: the orders, and a row for each type. */
export function everyType(registers) {
  const bytes = registers.flatMap((each) => [each >> 8, each & 255]);
  const arrangements = Object.values(ORDERS);
  const letters = (each) => each.map((byte) => (byte >= 32 && byte < 127 ? String.fromCharCode(byte) : "·")).join("");
  const octet = (byte) => byte.toString(16).padStart(2, "0");
  const first = (arrange) => arrange(bytes.slice(0, 2)).reduce((high, low) => 256 * high + low);
  const four = [
    ...rows(bytes, arrangements, () => true),
    ["text", arrangements.map((arrange) => letters(arrange(bytes)))],
    ["bytes", arrangements.map((arrange) => arrange(bytes).map(octet).join(""))],
    ["bits on", arrangements.map((arrange) => bitsOn(first(arrange)))],
    ["bool", [String(registers[0] !== 0), "", "", ""]],
  ];
  const tables = [[Object.keys(ORDERS), four]];
  if (bytes.length >= 8) tables.push([SPELLED, rows(bytes, SPELLED.map(spelled), (size) => size === 8)]);
  return tables;
}
