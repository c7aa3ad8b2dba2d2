// The parts of a view, ranges and tag lists: for requests, and described in words.

import { modicon } from "./numbers.js";
import { AREAS, areaOf } from "./standard.js";

/** Returns a range. `type` is one of `typeOf`. */
export function range(area, address, quantity, type, order) {
  return {
    kind: "range",
    area, address, quantity, type, order,
    ofBits: area < 3,
    width: type.width,
    title: `${areaOf(area).title} ${address} to ${address + quantity - 1}`,
  };
}

/** Returns a tag list. `source` is what a request has: a text and its format, or a profile. */
export const list = (title, source) => ({ kind: "tags", title, source });

/** Returns the fields of a part for a request. */
export function asked(part) {
  if (part.kind === "tags") return part.source;
  const { area, address, quantity, ofBits, type, order } = part;
  const typed = ofBits ? {} : { datatype: type.name, byteOrder: order };
  return { functionCode: area, address, quantity, ...typed };
}

/** Returns the read function of the area of a tag. */
export const functionOf = (tag) => AREAS[tag.area].code;

/** Describes a scale: a number, or the register that contains it. */
function scaled(scale) {
  if (typeof scale === "number") return `${scale}`;
  const source = typeof scale.from === "string" ? scale.from : `${scale.from.area.replace("_", " ")} ${scale.from.address}`;
  return scale.as === "exponent" ? `10^(${source})` : source;
}

/** Describes where a tag is, and what it holds. */
export function placed(tag) {
  const order = tag.order === "ABCD" ? "" : ` ${tag.order}`;
  const scale = tag.scale === 1 ? "" : ` × ${scaled(tag.scale)}`;
  const offset = tag.offset === 0 ? "" : ` ${tag.offset < 0 ? "−" : "+"} ${Math.abs(tag.offset)}`;
  return `${tag.area.replace("_", " ")} ${tag.address} = ${modicon(functionOf(tag), tag.address)}, ${tag.type}${order}${scale}${offset}`;
}

/** Returns the host and the port of a device, an IPv6 address in brackets. */
export const hostAndPort = ({ host, port }) => `${/^[^[]*:/.test(host) ? `[${host}]` : host}:${port}`;

/** Returns whether two descriptions of tags are equal. */
export const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);
