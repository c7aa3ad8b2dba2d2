// The parts of a view: ranges and tag lists, for requests and for the link.

import { packed, unpacked } from "./page_url.js";
import { modicon, typeOf } from "./numbers.js";
import { AREAS, areaOf, LAST_ADDRESS } from "./standard.js";

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

const spellings = new WeakMap();

/** Returns a part for the link. It is spelled once: later changes of the view are in the link before a reload. */
export function spelled(part) {
  if (!spellings.has(part)) spellings.set(part, spell(part));
  return spellings.get(part);
}

async function spell(part) {
  if (part.kind === "range") {
    const { area, address, quantity, type, order } = part;
    return [area, address, quantity, type.name, order].join();
  }
  const { profile, tags, format } = part.source;
  return profile ? `profile,${profile}` : `${format},${part.title},${await packed(tags)}`;
}

/** Returns the part that the link spells. Throws an error for one that can't be. */
export async function read(text) {
  const [first, ...rest] = text.split(",");
  if (first === "profile") return list(rest.join(), { profile: rest.join() });
  if (first === "yaml" || first === "csv") {
    const tags = await unpacked(rest.pop());
    return list(rest.join() || "Tags", { tags, format: first });
  }
  const [area, address, quantity] = [first, rest[0], rest[1]].map(Number);
  const [kind, size] = (rest[2] ?? "").split(":");
  const type = typeOf(kind, Number(size));
  const whole = [area, address, quantity].every(Number.isInteger) && type.width > 0;
  if (!whole || !areaOf(area) || address < 0 || quantity < 1 || address + quantity > LAST_ADDRESS + 1 || quantity > areaOf(area).most) {
    throw new Error(`“${text}” is not a range`);
  }
  return range(area, address, quantity, type, rest[3] ?? "ABCD");
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

/** Returns whether two descriptions of tags are equal. */
export const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);
