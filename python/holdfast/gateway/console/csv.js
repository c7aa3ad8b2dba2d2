// CSV files that the browser saves.

import { h } from "./dom.js";

/** Returns whether a text that begins with a sign is no formula: a sign alone, or a number. */
const isData = (text) => /^[-+](inf)?$/.test(text) || Number.isFinite(Number(text));

/** Quotes a cell. Text that a spreadsheet would take for a formula begins with an apostrophe. */
function cell(value) {
  let text = String(value ?? "");
  if (/^[=+\-@\t\r]/.test(text) && !isData(text)) text = `'${text}`;
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

/** Returns rows as CSV. */
export const csv = (rows) => rows.map((row) => `${row.map(cell).join(",")}\r\n`).join("");

/** Lets the browser save rows as a file. */
export function save(name, rows) {
  // The mark makes spreadsheets read UTF-8.
  const url = URL.createObjectURL(new Blob(["\uFEFF", csv(rows)], { type: "text/csv" }));
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

/** Returns a time for the name of a file. */
export const stamp = (date = new Date()) => date.toISOString().slice(0, 19).replaceAll(":", "-");
