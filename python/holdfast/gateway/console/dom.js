// Elements by a word: made, found, and told apart.

export const $ = (id) => document.getElementById(id);

/** An element with properties and children; `class`, `role`, `aria-…` and `data-…` as in HTML. */
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

/** Puts a message into a live region; it is read out even if it is the same as before. */
export function say(region, ...content) {
  const shown = content.filter((each) => each !== null);
  region.replaceChildren(...shown.map((each) => (typeof each === "string" ? h("p", {}, each) : each)));
}

/** Does one thing at a time for a button, which keeps the focus meanwhile. */
export async function once(button, work) {
  if (button.getAttribute("aria-disabled") === "true") return;
  button.setAttribute("aria-disabled", "true");
  try {
    await work();
  } finally {
    button.removeAttribute("aria-disabled");
  }
}

/** Hides a field with its label, or shows it; what is hidden is not checked. */
export function show(field, is) {
  field.closest("label").hidden = !is;
  field.disabled = !is;
}

/** Tabs that the arrow keys move between. */
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

/** What a custom property of the style sheet is now, for canvases. */
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Calls back when light turns to dark, or dark to light. */
export const onTheme = (callback) =>
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", callback);
