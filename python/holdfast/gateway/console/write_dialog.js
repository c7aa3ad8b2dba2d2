// The write dialog: asks for a value, reviews what it changes, then writes it.

import { keyHeader, notice, post, Problem } from "./api.js";
import { isPlain, ofTag, ofType, ofWords } from "./write_request.js";
import { $, h, pause } from "./dom.js";
import { extent, modicon, REGISTER_FORMS } from "./numbers.js";
import { hostAndPort, placed, same } from "./parts.js";
import * as reviews from "./review_tables.js";

const BITS_HELP = "0, 1, on or off. Separate values for consecutive coils with semicolons.";
const SEVERAL = "Separate values for consecutive registers with semicolons.";
const HELP = {
  register: () => `${REGISTER_FORMS}. ${SEVERAL}`,
  string: ({ size }) => `Up to ${size} ASCII characters. Shorter text is padded with zeros.`,
  bytes: ({ size }) => `${size} bytes in hex, such as 0a ff. ${SEVERAL}`,
  bool: () => `0, 1, on or off. ${SEVERAL}`,
  bit: () => "0, 1, on or off. This uses function 22. If the device does not support it, write the whole register.",
};
HELP.uint16 = HELP.register;
const NUMBER_HELP = ({ kind }) =>
  (kind.startsWith("float") ? `With a decimal point, as in 21.5. ${SEVERAL}` : `A whole number, ${extent(kind)}. ${SEVERAL}`);
const MAX_LISTED = 16;

/** How long the review waits before it reads the device again, in milliseconds. */
const REFRESH_MS = 3000;
/** How long the review may show what was read last when later reads fail, in milliseconds. */
const MAX_AGE_MS = 5000;
/**
 * How long values that are new in a review can't be confirmed, in milliseconds. Systems take two clicks within 500 ms
 * for a double click by default: its second click has seen nothing.
 */
const UNSEEN_MS = 700;
const READING = "Reading the current value…";
const CHANGED = "The current values have changed. Check the review again before you write.";

/** Reasons of errors after which the same request is refused again. */
const FINAL = ["no_such_name", "refused_target", "writes_off", "malformed", "unauthorized", "foreign_page", "too_large", "not_json"];
/** Reasons of errors that occur before the gateway turns to the device. */
const UNSENT = new Set([...FINAL, "busy"]);

/** The write dialog. */
export class Writer {
  constructor() {
    this.asked = null;
    this.dialog = $("write-dialog");
    const form = this.dialog.querySelector("form");
    $("write-cancel").addEventListener("click", () => {
      if (this.asked.sending) return;
      if (this.asked.change) this.back();
      else this.dialog.close();
    });
    $("write-as").addEventListener("change", () => this.help());
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.step(this.asked);
    });
    $("write-go").addEventListener("click", (event) => {
      // Some people need more time for a double click, and have set it.
      if (event.detail > 1) event.preventDefault();
    });
    form.addEventListener("keydown", (event) => {
      // A held Enter key must not confirm the next step.
      if (event.key === "Enter" && event.repeat) event.preventDefault();
    });
  }

  /**
   * Opens the dialog for an address of a range or a tag. Resolves to `written`, `refused` or
   * `unknown`, or to null when nothing was sent.
   */
  ask(target) {
    const { part, tag, area, address, ofBits } = target;
    const asked = { ...target, change: null, before: null, looks: 0, waits: 0, sending: null, outcome: null, closing: new AbortController() };
    this.asked = asked;
    const what = ofBits ? "coil" : "holding register";
    $("write-title").textContent = tag ? `Write ${tag.name}` : `Write ${what} ${address}`;
    $("write-where").textContent = `${tag ? placed(tag) : modicon(area, address)} of unit ${part.device.unitId} at ${hostAndPort(part.device)}`;
    this.offer(target);
    const states = Object.values(tag?.states ?? {});
    $("write-states").replaceChildren(...states.map((value) => h("option", { value })));
    if (states.length > 0) $("write-value").setAttribute("list", "write-states");
    else $("write-value").removeAttribute("list");
    $("write-value").value = "";
    $("write-error").replaceChildren();
    this.showStatus("");
    this.wait(asked, 0);
    this.freeze(asked, false);
    this.back();
    this.help();
    this.dialog.showModal();
    $("write-value").focus();
    return new Promise((resolve) => {
      this.dialog.addEventListener("close", async () => {
        asked.closing.abort();
        await asked.sending;
        resolve(asked.outcome);
      }, { once: true });
    });
  }

  /** Offers the plain register, and the type of the range where one of its values starts. */
  offer({ part, tag, address, ofBits }) {
    $("write-as-label").hidden = ofBits || tag !== null;
    if (ofBits || tag) {
      $("write-as").replaceChildren();
      return;
    }
    const forms = [["register", "plain register"], ["typed", part.type.name]];
    const offered = isPlain(part) ? [["typed", "uint16 (register)"]] : forms;
    $("write-as").replaceChildren(...offered.map(([value, text]) => h("option", { value }, text)));
    if ((address - part.address) % part.width === 0) $("write-as").value = "typed";
  }

  help() {
    const { part, tag, ofBits } = this.asked;
    const typed = $("write-as").value === "typed";
    const kind = typed ? part.type.kind : "register";
    $("write-help").textContent = tag ? tagHelp(tag) : ofBits ? BITS_HELP : (HELP[kind] ?? NUMBER_HELP)(part.type);
    $("write-value").required = !(typed && kind === "string") && !/^string/.test(tag?.type ?? "");
  }

  /** Returns to the first step. */
  back() {
    this.asked.change = null;
    $("write-ask").hidden = false;
    $("write-review").hidden = true;
    reviews.clear();
    $("write-go").textContent = "Review";
    $("write-cancel").textContent = "Cancel";
  }

  /** Returns whether the dialog is open for this write. */
  isAbout(asked) {
    return this.asked === asked && this.dialog.open;
  }

  /** Says what the dialog waits for, or what has changed. */
  showStatus(text) {
    $("write-wait").textContent = text;
  }

  /** Shows an error, also on a small screen. */
  fail(...content) {
    $("write-error").replaceChildren(...content);
    $("write-error").scrollIntoView({ block: "nearest" });
  }

  /** Lets the button wait for one thing more or less. It keeps the focus, unlike with `disabled`. */
  wait(asked, change) {
    asked.waits += change;
    if (this.asked === asked) $("write-go").setAttribute("aria-disabled", asked.waits > 0);
  }

  /** Lets nobody type what the step that runs would not see, or lets them type again. */
  freeze(asked, is) {
    if (this.asked === asked) $("write-value").readOnly = $("write-as").disabled = is;
  }

  /** Returns to the first step because of an error: what was reviewed can't be written. */
  reject(error) {
    this.back();
    this.fail(error instanceof Problem ? notice(error) : error.message);
  }

  /** Runs one step of a write at a time. The next dialog does not wait for a step of this one. */
  async step(asked) {
    if (asked.waits > 0) return;
    this.wait(asked, 1);
    this.freeze(asked, true);
    $("write-error").replaceChildren();
    let status = "";
    try {
      if (asked.change) status = await this.confirm(asked);
      else await this.review(asked);
    } catch (error) {
      if (this.isAbout(asked)) this.reject(error);
    }
    asked.sending = null;
    this.freeze(asked, false);
    this.wait(asked, -1);
    if (this.asked === asked) this.showStatus(status);
  }

  /** Checks what was typed, reads the current values, and shows them beside the new ones. */
  async review(asked) {
    this.showStatus(READING);
    const text = $("write-value").value;
    const isTyped = $("write-as").value === "typed" && !isPlain(asked.part);
    const change = await (asked.tag ? ofTag : isTyped ? ofType : ofWords)(asked, text);
    const before = await read(change, asked);
    if (!this.isAbout(asked)) return;
    asked.change = change;
    this.present(asked, before);
    $("write-review").hidden = false;
    $("write-ask").hidden = true;
    $("write-go").textContent = "Write it";
    $("write-cancel").textContent = "Back";
    $("write-go").focus();
    this.follow(asked, change);
  }

  /** Shows what was read beside the new values. It can be confirmed when it can have been seen. */
  async present(asked, found) {
    asked.before = found;
    reviews.show(asked.change, found);
    this.wait(asked, 1);
    await pause(UNSEEN_MS);
    this.wait(asked, -1);
  }

  /** Returns whether this change is under review, and nothing is sent yet. */
  isReviewed(asked, change) {
    return this.isAbout(asked) && asked.change === change && asked.sending === null;
  }

  /** Keeps the review current, as long as the device can be read. */
  async follow(asked, change) {
    while (this.isAbout(asked) && asked.change === change && !asked.before.error) {
      await pause(REFRESH_MS);
      // Nobody sees a hidden page. Before a write, it reads again.
      if (document.hidden || !this.isReviewed(asked, change)) continue;
      try {
        if (await this.refresh(asked, change)) this.showStatus(CHANGED);
      } catch (error) {
        if (this.isReviewed(asked, change)) this.reject(error);
      }
    }
  }

  /** Reads again, and shows the result. Returns whether it differs from what was shown. */
  async refresh(asked, change) {
    const now = await read(change, asked);
    const shown = asked.before;
    // A read that a write has overtaken may have seen the new values. One read may fail.
    if (!this.isReviewed(asked, change) || (now.error && isRecent(shown.time))) return false;
    const differs = !equal(now, shown);
    if (differs) {
      this.present(asked, now);
    } else {
      asked.before = now;
      reviews.showHeading(change, now);
    }
    return differs;
  }

  /** Writes what the review shows. If it has changed, shows that instead. Returns the status to show. */
  async confirm(asked) {
    const { change, before } = asked;
    this.showStatus(READING);
    const headers = await keyHeader();
    // A tag that can't be read may have another definition too.
    if (change.tag) await ofTag(asked, $("write-value").value);
    // Who has looked again may write, even if a value changes all the time.
    const isSeen = before.error || isRecent(asked.looks);
    if (!isSeen) await this.refresh(asked, change);
    if (!this.isReviewed(asked, change)) return "";
    if (!isSeen && !equal(before, asked.before)) {
      asked.looks = Date.now();
      return CHANGED;
    }
    this.showStatus("Writing…");
    asked.sending = this.write(asked, change, headers);
    await asked.sending;
    return "";
  }

  /** Writes the confirmed values. Never throws: `asked.outcome` has the outcome. */
  async write(asked, change, headers) {
    const doubt = asked.outcome === "unknown" ? "unknown" : "refused";
    asked.outcome = "unknown";
    try {
      await post(...change.request(), { headers });
      asked.outcome = "written";
      if (this.isAbout(asked)) this.dialog.close();
    } catch (error) {
      const refused = error.maybeWritten === false || (error.maybeWritten === null && UNSENT.has(error.reason));
      if (refused) asked.outcome = doubt;
      const outcomeText = refused ? "Not written." : "Unknown whether it was written.";
      const back = await change.read(asked.closing.signal).catch(() => null);
      if (!this.isAbout(asked)) return;
      this.back();
      this.fail(notice(error, outcomeText), h("p", {}, compared(change, asked.before, back)));
    }
  }
}

/** Reads what a change is about. An error of the device is a part of the result: some registers can only be written. */
async function read(change, { closing }) {
  try {
    return await change.read(closing.signal);
  } catch (error) {
    if (!(error instanceof Problem) || FINAL.includes(error.reason)) throw error;
    return { error };
  }
}

const equal = (one, other) => same([one.words, one.texts], [other.words, other.texts]);

/** Returns whether a time is at most `MAX_AGE_MS` ago. A clock that was set back makes it unknown. */
function isRecent(time) {
  const age = Date.now() - time;
  return age >= 0 && age <= MAX_AGE_MS;
}

function tagHelp({ unit, minText, maxText, states, type }) {
  const names = Object.values(states);
  const limits = [minText && `from ${minText}`, maxText && `to ${maxText}`].filter(Boolean).join(" ");
  return [
    names.length > 0 ? `One of ${names.join(", ")}.` : valueHelp(type),
    unit ? `In ${unit}.` : "",
    limits ? `Allowed: ${limits}.` : "",
  ].filter(Boolean).join(" ");
}

function valueHelp(type) {
  if (type.includes("[")) return "A list in JSON, as in [1, 2].";
  if (type.startsWith("string")) return "Text.";
  if (type.startsWith("bytes")) return `${type.split(":")[1]} bytes in base64, as in the table.`;
  return type === "bool" || type.startsWith("bit") ? "0, 1, on or off." : "A number, with a decimal point.";
}

/** Describes the values that were read back after a failed write. */
function compared(change, before, back) {
  if (back === null) return "Reading back failed: read the values before you continue.";
  if (!before.error && same(back.words, before.words)) return "Read back: unchanged.";
  if (change.isIn(back.words)) return "Read back: the new values are there.";
  const found = back.texts.length > 0 ? back.texts : back.words.map(reviews.inWords);
  return `Read back: ${before.error ? "not" : "neither the old nor"} the new values, but ${found.slice(0, MAX_LISTED).join(", ")}.`;
}
