// Registers as numbers, as text, and as what people write.

export const hex = (register) => register.toString(16).toUpperCase().padStart(4, "0");
export const binary = (register) => register.toString(2).padStart(16, "0").replace(/(....)(?=.)/g, "$1 ");

export const WIDTHS = {
  int16: 1, uint16: 1, bcd16: 1, float16: 1,
  int32: 2, uint32: 2, bcd32: 2, float32: 2,
  int64: 4, uint64: 4, float64: 4,
};

const DIGITS = { 1: "0", 2: "1", 3: "4", 4: "3" };

/** An address as Modicon wrote it: 40001 is holding register 0. */
export const modicon = (area, address) =>
  DIGITS[area] + String(address + 1).padStart(address > 9998 ? 5 : 4, "0");

/** A register as it is written: decimal, 0x and 0b, or negative. Throws what is wrong with it. */
export function register(text) {
  const plain = text.trim().replaceAll("_", "");
  const form = /^(-?\d{1,5}|0[xX][0-9a-fA-F]{1,4}|0[bB][01]{1,16})$/;
  const value = form.test(plain) ? Number(plain) : NaN;
  if (!(value >= -32768 && value <= 65535)) {
    throw new Error(`“${text.trim()}” is no register: −32768 to 65535, 0x0000 to 0xFFFF or 0b…`);
  }
  return value < 0 ? value + 65536 : value;
}

/** A bit as it is written. */
export function bit(text) {
  const word = text.trim().toLowerCase();
  if (["1", "on", "true"].includes(word)) return true;
  if (["0", "off", "false"].includes(word)) return false;
  throw new Error(`“${text.trim()}” is no bit: 0, 1, on or off`);
}

/** The least and the most of types of whole numbers. */
const EXTENTS = {
  int16: [-(2n ** 15n), 2n ** 15n - 1n], uint16: [0n, 2n ** 16n - 1n], bcd16: [0n, 9999n],
  int32: [-(2n ** 31n), 2n ** 31n - 1n], uint32: [0n, 2n ** 32n - 1n], bcd32: [0n, 99999999n],
  int64: [-(2n ** 63n), 2n ** 63n - 1n], uint64: [0n, 2n ** 64n - 1n],
};

/** A number of a type as JSON text, digit by digit as it was written. Throws what is wrong with it. */
export function numeral(text, type) {
  const plain = text.trim().replace(/^\+/, "");
  const extent = EXTENTS[type];
  if (!extent && /^-?(0|[1-9]\d*)(\.\d+)?([eE][-+]?\d+)?$/.test(plain)) return plain;
  if (extent && /^-?(0|[1-9]\d{0,19})$/.test(plain)) {
    const whole = BigInt(plain);
    if (whole >= extent[0] && whole <= extent[1]) return plain;
  }
  throw new Error(`“${text.trim()}” is no ${type}${extent ? `: ${extent[0]} to ${extent[1]}` : ""}`);
}

const READERS = {
  int16: [2, (view) => view.getInt16(0)],
  uint16: [2, (view) => view.getUint16(0)],
  int32: [4, (view) => view.getInt32(0)],
  uint32: [4, (view) => view.getUint32(0)],
  float32: [4, (view) => Number(view.getFloat32(0).toPrecision(7))],
  int64: [8, (view) => view.getBigInt64(0)],
  uint64: [8, (view) => view.getBigUint64(0)],
  float64: [8, (view) => Number(view.getFloat64(0).toPrecision(12))],
};

const ORDERS = {
  ABCD: (bytes) => bytes,
  CDAB: (bytes) => pairs(bytes).reverse().flat(),
  BADC: (bytes) => pairs(bytes).flatMap(([a, b]) => [b, a]),
  DCBA: (bytes) => [...bytes].reverse(),
};

const pairs = (bytes) => bytes.filter((_, at) => at % 2 === 0).map((byte, at) => [byte, bytes[2 * at + 1]]);

/** What registers are in every type and order: rows of a type and its texts by order. */
export function everyType(registers) {
  const bytes = registers.flatMap((each) => [each >> 8, each & 255]);
  const rows = [];
  for (const [type, [size, read]] of Object.entries(READERS)) {
    if (bytes.length < size) continue;
    const own = bytes.slice(0, size);
    const texts = Object.values(ORDERS).map((order) => {
      const view = new DataView(Uint8Array.from(order(own)).buffer);
      return String(read(view));
    });
    rows.push([type, texts]);
  }
  const letters = bytes.map((byte) => (byte >= 32 && byte < 127 ? String.fromCharCode(byte) : "·"));
  rows.push(["text", [letters.join(""), null, pairs(letters).flatMap(([a, b]) => [b, a]).join(""), null]]);
  return rows;
}

export const orders = Object.keys(ORDERS);
