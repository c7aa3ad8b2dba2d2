// The view in the page's URL, so that it can be bookmarked, shared and reloaded.

/** Returns text as a part of a URL: deflated, in base64url. */
export async function packed(text) {
  const bytes = new Uint8Array(await new Response(
    new Blob([text]).stream().pipeThrough(new CompressionStream("deflate-raw")),
  ).arrayBuffer());
  let binary = "";
  for (const byte of bytes) binary += String.fromCharCode(byte);
  return btoa(binary).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

const MAX_LENGTH = 65536;

/** Returns the text of a part of a URL. Throws an error if it is damaged or too long. */
export async function unpacked(part) {
  const binary = atob(part.replaceAll("-", "+").replaceAll("_", "/"));
  const bytes = Uint8Array.from(binary, (letter) => letter.charCodeAt(0));
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"))
    .pipeThrough(new TextDecoderStream("utf-8", { fatal: true })).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return text;
    text += value;
    if (text.length > MAX_LENGTH) throw new Error("the tag list of the link is too long");
  }
}

/** Returns the parameters of the page's URL. */
export const given = () => new URLSearchParams(location.hash.slice(1));

/** Puts parameters into the page's URL, and removes those that are null. An array gives several. */
export function put(parameters) {
  const query = given();
  for (const [name, value] of Object.entries(parameters)) {
    query.delete(name);
    if (Array.isArray(value)) value.forEach((each) => query.append(name, each));
    else if (value !== null) query.set(name, value);
  }
  history.replaceState(null, "", `#${query}`);
}
