// The history of a value: an hour, with a gap wherever there was no value.

/** The longest time that is kept, in seconds. */
export const SPAN = 3600;
/** Newer points are all kept; of older ones, the extremes of each bucket. */
const RECENT = 120;
const BUCKET = 2;
const SLACK = 500;
const MOMENT = 0.001;

/** Points in order of time, with the texts of their values; a value of null begins a gap. */
export class History {
  constructor() {
    this.times = [];
    this.values = [];
    this.texts = [];
    /** When the last value was confirmed. Later, nothing is known. */
    this.until = 0;
    this.compact = SLACK;
  }

  /** Takes the value that was read at a time in seconds. Its text may have more digits than the number. */
  take(time, value, text = String(value)) {
    if (text !== this.texts.at(-1)) this.push(time, value, text);
    this.until = time;
  }

  /** Ends the line at the last confirmed value. */
  gap() {
    if (this.values.length === 0 || this.values.at(-1) === null) return;
    this.push(this.until, this.values.at(-1), this.texts.at(-1));
    this.push(this.until + MOMENT, null, null);
  }

  /** Moves what is known by some seconds. */
  move(seconds) {
    if (this.times.length === 0) return;
    this.times = this.times.map((time) => time + seconds);
    this.until += seconds;
  }

  push(time, value, text) {
    this.times.push(time);
    this.values.push(value);
    this.texts.push(text);
    if (this.times.length >= this.compact) {
      this.decimate(time);
      this.compact = this.times.length + SLACK;
    }
  }

  /** Forgets what is too old, and thins out what is no longer recent. */
  decimate(now) {
    const kept = [];
    let at = this.times.findLastIndex((time) => time < now - SPAN);
    at = Math.max(0, at);
    while (at < this.times.length && this.times[at] < now - RECENT) {
      const bucket = Math.floor(this.times[at] / BUCKET);
      let end = at;
      while (end < this.times.length && Math.floor(this.times[end] / BUCKET) === bucket) end += 1;
      kept.push(...extremes(this.values, at, end));
      at = end;
    }
    while (at < this.times.length) kept.push(at++);
    this.times = kept.map((each) => this.times[each]);
    this.values = kept.map((each) => this.values[each]);
    this.texts = kept.map((each) => this.texts[each]);
  }

  /** Returns the points to draw: times, and values and their texts with null for gaps. */
  points() {
    const last = this.values.at(-1);
    if (last === undefined || last === null) return [this.times, this.values, this.texts];
    return [[...this.times, this.until], [...this.values, last], [...this.texts, this.texts.at(-1)]];
  }

  /** Returns the gaps as pairs of times; the last one may have no end. */
  gaps() {
    const found = [];
    this.values.forEach((value, at) => {
      if (value === null) found.push([this.times[at], this.times[at + 1] ?? null]);
    });
    return found;
  }
}

/** Returns the indexes of the first, least, greatest and last value from `start` to `end`, and of a gap. */
function extremes(values, start, end) {
  const found = new Set([start, end - 1]);
  let least = -1;
  let greatest = -1;
  let gap = -1;
  for (let at = start; at < end; at += 1) {
    if (values[at] === null) {
      if (gap < 0) gap = at;
    } else {
      if (least < 0 || values[at] < values[least]) least = at;
      if (greatest < 0 || values[at] > values[greatest]) greatest = at;
    }
  }
  for (const at of [least, greatest, gap]) if (at >= 0) found.add(at);
  return [...found].sort((a, b) => a - b);
}
