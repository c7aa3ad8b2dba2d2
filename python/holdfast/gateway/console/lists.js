// The dialog that adds a tag list to the view: a profile, a file, or pasted text.

import { get, post } from "./api.js";
import { $, h, once } from "./dom.js";
import { list } from "./parts.js";

/** Returns the format of a tag list: by the end of the name of its file, or else by its content. */
const formatOf = (name, text) => {
  if (/\.csv$/i.test(name)) return "csv";
  return /\.(ya?ml|json)$/i.test(name) || /^\s*(order|tags)\s*:/m.test(text) ? "yaml" : "csv";
};

/** Returns the text of a file. Throws an error for one that is not UTF-8, whose text would be damaged. */
async function textOf(file) {
  const content = await file.arrayBuffer();
  try {
    return new TextDecoder("utf-8", { fatal: true }).decode(content);
  } catch {
    throw new Error(`${file.name}: not UTF-8, allowed: YAML or CSV in UTF-8; save it as UTF-8`);
  }
}

/** The dialog for tag lists. `add` takes the part that was chosen, or throws an error. */
export class Lists {
  constructor(add) {
    this.add = add;
    this.dialog = $("tags-dialog");
    this.name = "";
    this.closing = new AbortController();
    this.dialog.addEventListener("close", () => this.closing.abort());
    $("tags-file").addEventListener("change", async () => {
      const [file] = $("tags-file").files;
      if (!file) return;
      const { signal } = this.closing;
      const [text, problem] = await textOf(file).then((found) => [found, ""], (error) => ["", error.message]);
      if (signal.aborted) return;
      this.name = problem ? "" : file.name;
      $("tags-text").value = text;
      $("tags-error").textContent = problem;
      $("tags-profile").value = "";
      this.adapt();
    });
    $("tags-profile").addEventListener("change", () => this.adapt());
    $("tags-cancel").addEventListener("click", () => this.dialog.close());
    this.dialog.querySelector("form").addEventListener("submit", (event) => {
      event.preventDefault();
      once($("tags-go"), () => this.take());
    });
  }

  /** Opens the dialog, with the profiles of the configuration. */
  async ask() {
    this.name = "";
    this.closing = new AbortController();
    const { signal } = this.closing;
    $("tags-file").value = $("tags-text").value = $("tags-error").textContent = "";
    $("tags-profile").replaceChildren(h("option", { value: "" }, "None: the text below"));
    this.adapt();
    this.dialog.showModal();
    const { profiles } = await get("/api/gateway/profiles").catch((error) => {
      if (!signal.aborted) $("tags-error").textContent = `The profiles of the configuration can't be listed: ${error.message}`;
      return { profiles: [] };
    });
    if (signal.aborted) return;
    $("tags-profile").append(...profiles.map(({ name, tags }) => h("option", { value: name }, `${name} (${tags} tags)`)));
    this.adapt();
  }

  adapt() {
    $("tags-profile").closest("label").hidden = $("tags-profile").options.length === 1;
    $("tags-text").required = $("tags-profile").value === "";
    for (const id of ["tags-file", "tags-text"]) $(id).closest("label").hidden = $("tags-profile").value !== "";
  }

  /** Lets the gateway check the list, and adds it unless the dialog was closed meanwhile. */
  async take() {
    const { signal } = this.closing;
    const profile = $("tags-profile").value;
    const text = $("tags-text").value;
    const source = profile ? { profile } : { tags: text, format: formatOf(this.name, text) };
    $("tags-error").textContent = "";
    try {
      const { tags } = await post("/api/gateway/tags", source, { signal });
      if (signal.aborted) return;
      this.add(list(profile || this.name || `${tags.length} ${tags.length === 1 ? "tag" : "tags"}`, source));
      this.dialog.close();
    } catch (error) {
      if (!signal.aborted) $("tags-error").textContent = error.message;
    }
  }
}
