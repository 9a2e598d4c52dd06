// Times as texts: in UTC or local time, as the user chooses, and always with 24 hours a day.

import { language, t } from "../texts.js";

const KEY = "multidrop-times";
const LOCALE = language === "en" ? "en-GB" : language;
let zone = kept() === "local" ? "local" : "UTC";
let formats = {};

function kept() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  } // the browser forbids storage
}

export const isUtc = () => zone === "UTC";

export function switchZone() {
  zone = isUtc() ? "local" : "UTC";
  formats = {};
  try {
    localStorage.setItem(KEY, zone);
  } catch {
    /* the browser forbids storage: the choice lasts until the page is closed */
  }
  dispatchEvent(new Event("timezone"));
}

function formatted(ms, name, options) {
  formats[name] ??= new Intl.DateTimeFormat(LOCALE, {
    hourCycle: "h23",
    timeZone: isUtc() ? "UTC" : undefined,
    ...options,
  });
  return formats[name].format(ms);
}

const TIME = { hour: "2-digit", minute: "2-digit", second: "2-digit" };
const DAY = { day: "numeric", month: "short" };

export const time = ms => formatted(ms, "time", TIME);
export const minute = ms => formatted(ms, "minute", { hour: "2-digit", minute: "2-digit" });
const day = ms => formatted(ms, "day", DAY);
export const milli = ms =>
  `${time(ms)}.${String(((Math.floor(ms) % 1000) + 1000) % 1000).padStart(3, "0")}`;

// Return date and time, with the year if that is not the present year.
export function moment(ms) {
  const far = Math.abs(Date.now() - ms) > 300 * 86400e3;
  return `${formatted(ms, far ? "year" : "day", far ? { ...DAY, year: "numeric" } : DAY)}, ${time(ms)}`;
}

// Return only the time of day if the time is today, else date and time.
export const when = ms => (day(ms) === day(Date.now()) ? time(ms) : moment(ms));

export const zoneName = () => (isUtc() ? "UTC" : t("local"));

// Convert a time (ms) to the text of an input field for date and time, and such a text to a time.
export function field(ms) {
  const shift = isUtc() ? 0 : new Date(ms).getTimezoneOffset() * 60000;
  return new Date(ms - shift).toISOString().slice(0, 19);
}
export const parsed = text => Date.parse(isUtc() ? `${text}Z` : text);

// Return a duration as text, in the largest unit that fits: "0.4 s", "42 s", "7 min", "3.5 h", "12 days".
export function lasting(ms) {
  const s = Math.max(0, ms) / 1000;
  if (s < 10) return t("{n} s", { n: s.toFixed(1) });
  if (s < 120) return t("{n} s", { n: Math.round(s) });
  if (s < 7200) return t("{n} min", { n: Math.round(s / 60) });
  if (s < 48 * 3600) return t("{n} h", { n: (s / 3600).toFixed(1) });
  return t("{n} days", { n: Math.round(s / 86400) });
}

// Return for how long an alarm has lasted. An alarm that was present when the gateway started may have
// started earlier.
export const since = ({ time: begin, is_before: isBefore }, now) =>
  isBefore ? t("since before {time}", { time: when(begin).slice(0, -3) }) : lasting(now - begin);

// Return the texts of a time axis, with as many digits as the distance between its ticks needs. uPlot's times
// are in s.
export function ticks(splits, step) {
  return splits.map(s => {
    const ms = s * 1000;
    if (step >= 86400) return day(ms);
    if (time(ms) === "00:00:00") return day(ms);
    if (step >= 60) return minute(ms);
    return step >= 1 ? time(ms) : milli(ms).slice(0, -2);
  });
}

// Return a Date whose local fields show the time in the chosen time zone. uPlot places its ticks by these
// fields.
export const tickDate = s =>
  isUtc() ? globalThis.uPlot.tzDate(new Date(s * 1000), "Etc/UTC") : new Date(s * 1000);
