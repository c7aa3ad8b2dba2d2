// The view in the page's URL, so that it can be bookmarked, shared and reloaded.

import { $ } from "./dom.js";
import { typeOf } from "./numbers.js";
import { list, range } from "./parts.js";
import { areaOf, LAST_ADDRESS, TYPES } from "./standard.js";

/** The fields of the page that are parameters with the same names. */
const DEVICE = ["host", "port", "unit", "transport", "timeout", "server"];
const RANGE = ["area", "address", "quantity", "type", "size", "order", "letters", "interval"];

/** The other parameters, and those of them that a link may have several times. */
const MORE = ["watch", "span"];
const SEVERAL = ["part", "plot"];

const given = () => new URLSearchParams(location.hash.slice(1));

/** Returns the view: the fields that it has with their values, its parts as spelled, and what is watched and plotted. */
export function view() {
  const query = given();
  const fields = (ids) => ids.filter((id) => query.has(id)).map((id) => [id, query.get(id)]);
  return {
    device: fields(DEVICE),
    range: fields(RANGE),
    parts: query.getAll("part"),
    watched: query.get("watch") === "1",
    plotted: query.getAll("plot"),
    span: query.get("span"),
  };
}

/** Fills in fields. A choice that there is none of changes nothing. */
export function fill(fields) {
  for (const [id, value] of fields) {
    if (!$(id).options || [...$(id).options].some((each) => each.value === value)) $(id).value = value;
  }
}

/** Names the fields that could not be filled in, and those whose value is invalid. */
export const unfit = (fields) =>
  fields.filter(([id, value]) => $(id).value !== value || !$(id).checkValidity()).map(([id, value]) => `${id} is “${value}”`);

const unknown = (query) => [...new Set(query.keys())].filter((name) => ![...DEVICE, ...RANGE, ...MORE, ...SEVERAL].includes(name));

/** Names the parameters that no link has, and those that it has once but were given several times. */
function strange() {
  const query = given();
  const repeated = [...DEVICE, ...RANGE, ...MORE].filter((name) => query.getAll(name).length > 1);
  return [...unknown(query).map((name) => `“${name}” is unknown`), ...repeated.map((name) => `${name} is given more than once`)];
}

/** Names what keeps the page from connecting by itself: what of the link may be a part of the device and can't be used. */
export const deviceFlaws = () => [...unfit(view().device), ...strange()];

/** Stores the device. `valueOf` returns the value of a field, or null for one that is left out. */
export function putDevice(valueOf) {
  put(Object.fromEntries(DEVICE.map((id) => [id, valueOf(id)])));
}

/** Stores everything but the device, and removes what is unknown. `parts` are spelled, `span` may be null. */
export function putValues(valueOf, { parts, watched, plotted, span }) {
  const range = Object.fromEntries(RANGE.map((id) => [id, valueOf(id)]));
  const gone = Object.fromEntries(unknown(given()).map((name) => [name, null]));
  put({ ...gone, ...range, part: parts, watch: watched ? "1" : null, plot: plotted, span });
}

/** Removes that the view is watched. */
export const putStopped = () => put({ watch: null });

/** Puts parameters into the page's URL, and removes those that are null. An array gives several. */
function put(parameters) {
  const query = given();
  for (const [name, value] of Object.entries(parameters)) {
    query.delete(name);
    if (Array.isArray(value)) value.forEach((each) => query.append(name, each));
    else if (value !== null) query.set(name, value);
  }
  history.replaceState(null, "", `#${query}`);
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
export async function readPart(text) {
  const [first, ...rest] = text.split(",");
  if (first === "profile") return list(rest.join(), { profile: rest.join() });
  if (first === "yaml" || first === "csv") {
    const part = rest.pop();
    const title = rest.join() || "Tags";
    const tags = await unpacked(part).catch(() => {
      throw new Error(`the tag list “${title}” is damaged, or longer than ${MAX_LENGTH} characters`);
    });
    return list(title, { tags, format: first });
  }
  const [area, address, quantity] = [first, rest[0], rest[1]].map(Number);
  const [kind, size] = (rest[2] ?? "").split(":");
  const type = ["bit", "string", "bytes"].includes(kind) || Object.hasOwn(TYPES, kind) ? typeOf(kind, Number(size)) : null;
  const whole = [area, address, quantity].every(Number.isInteger) && type?.width > 0 && (area > 2 || kind === "bool");
  if (!whole || !areaOf(area) || address < 0 || quantity < 1 || address + quantity > LAST_ADDRESS + 1 || quantity > areaOf(area).most) {
    throw new Error(`“${text}” is not a range`);
  }
  return range(area, address, quantity, type, rest[3] ?? "ABCD");
}

/** Returns text as a part of a URL: deflated, in base64url. */
async function packed(text) {
  const bytes = new Uint8Array(await new Response(
    new Blob([text]).stream().pipeThrough(new CompressionStream("deflate-raw")),
  ).arrayBuffer());
  let binary = "";
  for (const byte of bytes) binary += String.fromCharCode(byte);
  return btoa(binary).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

const MAX_LENGTH = 65536;

/** Returns the text of a part of a URL. Throws an error if it is damaged or too long. */
async function unpacked(part) {
  const binary = atob(part.replaceAll("-", "+").replaceAll("_", "/"));
  const bytes = Uint8Array.from(binary, (letter) => letter.charCodeAt(0));
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"))
    .pipeThrough(new TextDecoderStream("utf-8", { fatal: true })).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return text;
    text += value;
    if (text.length > MAX_LENGTH) throw new Error("too long");
  }
}
