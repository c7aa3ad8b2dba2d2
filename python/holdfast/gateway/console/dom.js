// Creates, finds and updates elements.

export const $ = (id) => document.getElementById(id);

/** Creates an element with properties and children; `class`, `role`, `aria-…`, `data-…` as in HTML. */
export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element && !name.includes("-")) element[name] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((each) => each !== null && each !== undefined));
  return element;
}

/** Creates a button that looks like text. Its label says what it is for where the text alone does not. */
export const quiet = (text, label, onclick, kind = "") =>
  h("button", { class: `quiet ${kind}`, type: "button", "aria-label": label, onclick }, text);

/** Creates a table. The first cell of a row is its heading. */
export const table = (kind, caption, head, rows) =>
  h("table", { class: kind },
    caption,
    h("thead", {}, h("tr", {}, head.map((text) => h("th", { scope: "col" }, text)))),
    h("tbody", {}, rows.map(([name, ...cells]) =>
      h("tr", {}, h("th", { scope: "row" }, name), cells.map((cell) => h("td", {}, cell))))));

/** Puts a message into a live region. Screen readers announce it even if it is unchanged. */
export function say(region, ...content) {
  const shown = content.filter((each) => each !== null);
  region.replaceChildren(...shown.map((each) => (typeof each === "string" ? h("p", {}, each) : each)));
}

/** Runs one action of a button at a time. The button keeps the focus, unlike with `disabled`. */
export async function once(button, work) {
  if (button.getAttribute("aria-disabled") === "true") return;
  button.setAttribute("aria-disabled", "true");
  try {
    await work();
  } finally {
    button.removeAttribute("aria-disabled");
  }
}

/** Waits, or until `signal` is aborted. */
export const pause = (milliseconds, signal) => new Promise((resolve) => {
  setTimeout(resolve, signal?.aborted ? 0 : milliseconds);
  signal?.addEventListener("abort", resolve);
});

/**
 * Returns what tells the milliseconds since now, by the clock that tells more: the clock of the machine may be set back,
 * and the other one may stand still while the machine sleeps.
 */
export function stopwatch() {
  const [time, steady] = [Date.now(), performance.now()];
  return () => Math.max(Date.now() - time, performance.now() - steady);
}

/** Returns a time in milliseconds as hours, minutes and seconds. */
export const clock = (time) => new Date(time).toTimeString().slice(0, 8);

/** Shows or hides a field with its label. Hidden fields are not validated. */
export function show(field, is) {
  field.closest("label").hidden = !is;
  field.disabled = !is;
}

/** Makes a list of tabs that the arrow keys move between. */
export function tabs(list) {
  const all = [...list.querySelectorAll("[role=tab]")];
  const choose = (chosen) => {
    for (const tab of all) {
      const on = tab === chosen;
      tab.setAttribute("aria-selected", on);
      tab.tabIndex = on ? 0 : -1;
      $(tab.getAttribute("aria-controls")).hidden = !on;
    }
  };
  for (const tab of all) tab.addEventListener("click", () => choose(tab));
  list.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const next = all[(all.indexOf(document.activeElement) + step + all.length) % all.length];
    choose(next);
    next.focus();
  });
  return choose;
}

/** Returns the current value of a custom property of the style sheet, for canvases. */
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Calls `callback` when the color scheme changes, until `signal` is aborted. */
export const onTheme = (callback, signal) =>
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", callback, { signal });
