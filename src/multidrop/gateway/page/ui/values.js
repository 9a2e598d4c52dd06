// Values as texts. An unknown value is shown as a dash, never as 0; an old value is shown with its time.

import { said, t } from "../texts.js";
import * as clock from "./clock.js";
import { make, put, setClass } from "./dom.js";

export const STATES = {
  runs: t("running"),
  stands: t("stopped"),
  fault: t("fault"),
  silent: t("silent"),
  still: t("at rest: 0 Hz"),
  unknown: t("unknown"),
};
export const ALARMS = {
  fault: t("fault"),
  stopped: t("stopped by itself"),
  limit: t("limit"),
  port: t("line lost"),
  silent: t("silent"),
};
export const UNKNOWN = "–";
const MOST_BITS = 32;

export const words = name => name.replaceAll("_", " ");

// Return a register's title in the viewer's language, or its name if the gateway has no title.
export const registerName = ({ name, title: known }) => known || words(name);

// Return a value as text without its unit: the number, or its name if the register has named values.
export function text(value, register) {
  if (value === null || value === undefined || Number.isNaN(value)) return UNKNOWN;
  if (register?.kind === "words")
    return register.words?.[value] ? `${said(words(register.words[value]))} (${value})` : String(value);
  if (register?.kind === "bits") return bits(value, register.words ?? {});
  return number(Number(value), register?.digits);
}

// Return a number with this many decimals. If `digits` is null, as for a float, return all decimals that the
// number needs.
export function number(value, digits) {
  if (Number.isInteger(digits)) return value.toFixed(digits);
  if (Math.fround(value) === value)
    for (let most = 1; most < 10; most++) {
      const told = Number(value.toPrecision(most));
      if (Math.fround(told) === value) return String(told);
    }
  return String(Number(value.toPrecision(12)));
}

function bits(value, names) {
  const set = [];
  for (let bit = 0; bit < MOST_BITS; bit++)
    if (Math.floor(value / 2 ** bit) % 2) set.push(said(words(names[2 ** bit] ?? `bit ${bit}`)));
  return set.length ? set.join(", ") : t("none set");
}

export const unit = register =>
  register?.unit && register.kind !== "words" && register.kind !== "bits" ? register.unit : "";

export const unitName = register => said(unit(register));

// Return a value's text with the register's unit, if the register has one.
export const withUnit = (told, register) => `${told} ${unitName(register)}`.trim();

// Return a register's name with its unit, as the head of a plot or a field.
export const title = register => [registerName(register), unitName(register)].filter(Boolean).join(", ");

// Make the elements of a table cell for a value: the number, its unit, and the time of an old value.
export function makeValue() {
  const parts = {
    number: make("span", { class: "number" }),
    unit: make("span", { class: "u" }),
    age: make("small", { class: "dated" }),
  };
  parts.whole = make("span", { class: "value" }, parts.number, parts.unit, parts.age);
  return parts;
}

// Show a register's newest value (see store.reading) in the elements that `makeValue` returned.
export function showValue(parts, reading, register, isDated = true, isNamed = isDated) {
  const isThere = reading !== null && reading.value !== null;
  const isOld = isThere && reading.isOld;
  put(parts.number, isThere ? text(reading.value, register) : UNKNOWN);
  // a number without a unit is shown with the register's name
  const isBare = !unit(register) && register?.kind === "number" && isNamed;
  put(parts.unit, isThere ? (isBare ? registerName(register) : unitName(register)) : "");
  put(parts.age, isOld && isDated ? t("{age} old", { age: clock.lasting(reading.age) }) : "");
  setClass(parts.whole, "old", isOld);
  const why = reason(reading);
  if (parts.whole.title !== why) parts.whole.title = why;
}

// Return why a value is missing or old; "" for a fresh value.
function reason(reading) {
  if (reading === null) return t("never read");
  if (reading.value === null) return t("never read: {status}", { status: said(reading.status) });
  if (!reading.isOld) return "";
  const at = `${clock.moment(reading.ms)} ${clock.zoneName()}`;
  if (reading.status === "ok") return t("of {time}", { time: at });
  return t("of {time}; since then: {status}", { time: at, status: said(reading.status) });
}

// Return a number of drives as text: "1 drive", "31 drives".
export const drives = n => t(n === 1 ? "{n} drive" : "{n} drives", { n });

// Return a share in per cent, or a dash if it is unknown. A small share is never shown as 0.
export function share(part) {
  if (part === null || part === undefined) return UNKNOWN;
  const percent = part * 100;
  if (percent === 0) return "0 %";
  if (percent < 0.1) return "< 0.1 %";
  return percent < 10 ? `${percent.toFixed(1)} %` : `${Math.round(percent)} %`;
}

// Make the elements of a bar that shows how much of a line's time is used, with a mark at the planned share.
export function makeUse() {
  const parts = { used: make("i"), planned: make("u") };
  parts.whole = make("span", { class: "use", role: "img" }, parts.used, parts.planned);
  return parts;
}

// Show the used and the planned share (null if unknown) in the elements that `makeUse` returned. Return both
// as a text.
export function showUse({ used: part, planned: mark, whole }, used, planned) {
  part.style.width = `${Math.min(1, used ?? 0) * 100}%`;
  mark.style.left = `${Math.min(1, planned ?? 0) * 100}%`;
  mark.hidden = planned === null;
  const words = t("{used} used, {planned} planned", { used: share(used), planned: share(planned) });
  if (whole.getAttribute("aria-label") !== words) whole.setAttribute("aria-label", words);
  return words;
}

export const milliseconds = ms =>
  ms === null || ms === undefined ? UNKNOWN : t("{n} ms", { n: ms < 10 ? ms.toFixed(1) : Math.round(ms) });
