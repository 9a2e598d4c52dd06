// Rows of the table of drives: one for each drive, and above the drives of each line one for the line.

import { driveAge, isLive, key, noteOf, reading, state, store } from "../../data/store.js";
import { said, t } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { fill, glyph, make, named, put, setClass } from "../../ui/dom.js";
import { STATES, UNKNOWN, makeUse, makeValue, share, showUse, showValue } from "../../ui/values.js";

export const COLUMNS = 8;
const MANY = 0.01; // share of failed reads from which a warning is shown
const FULL_HZ = [50, 60, 80, 100, 150, 200, 300, 400, 600, 1000, 2000, 4000]; // frequencies of a full bar

// Return a line's row and the elements in it that change. A click on the line's name calls `unfold`, unless
// it is null.
export function makeHead(line, unfold) {
  const name = named(line.name, { class: "linename" });
  const parts = {
    line,
    fold: unfold && make("button", { type: "button", class: "fold", onclick: unfold }, name),
    count: make("span"),
    bar: makeUse(),
    share: make("span"),
    rate: make("span", { class: "wide" }),
    missed: make("span"),
  };
  parts.row = make(
    "tr",
    { class: "head" },
    make(
      "th",
      { colspan: COLUMNS, scope: "rowgroup" },
      make(
        "div",
        { class: "linehead" },
        parts.fold ?? name,
        parts.fold && parts.count,
        make("span", { class: "wide port" }, [line.port, line.speed].filter(Boolean).join(" · ")),
        make("span", { class: "wire" }, `${t("wire")} `, parts.bar.whole, parts.share),
        parts.rate,
        parts.missed,
      ),
    ),
  );
  return parts;
}

// Return a drive's row and the elements in it that change.
export function makeRow(drive) {
  const parts = {
    name: drive.name,
    frequency: makeValue(),
    current: makeValue(),
    bar: make("i"),
    set: make("u"),
    canvas: make("canvas", { "aria-hidden": "true" }),
    shape: make("span", { class: "shape" }),
    word: make("span", { class: "word" }),
    age: make("td", { class: "age", "data-head": t("age") }),
    missed: make("td", { class: "missed", "data-head": t("missed") }),
  };
  parts.link = make(
    "a",
    { href: `#/drives/${encodeURIComponent(drive.name)}`, tabindex: "-1", title: drive.name },
    named(drive.name),
  );
  parts.bars = make("span", { class: "bar", "aria-hidden": "true" }, parts.bar, parts.set);
  parts.row = make(
    "tr",
    { class: "drive" },
    make("td", { class: "name" }, parts.link),
    make("td", { class: "model" }, `${drive.family} ${drive.address}`),
    make("td", { class: "state" }, make("span", { class: "st" }, parts.shape, parts.word)),
    make("td", { class: "frequency" }, parts.bars, parts.frequency.whole),
    make("td", { class: "current" }, parts.current.whole),
    make("td", { class: "minute" }, parts.canvas),
    parts.age,
    parts.missed,
  );
  parts.row.addEventListener("click", event => {
    if (!event.target.closest("a")) location.hash = parts.link.hash;
  });
  parts.text = `${drive.name} ${drive.family} ${drive.address}`.toLowerCase();
  return parts;
}

function stateWord(is, drive, age) {
  if (is === "fault") return drive.fault ? said(drive.fault) : STATES.fault;
  if (is !== "silent") return STATES[is] ?? is;
  return age === null ? t("silent, never answered") : t("silent for {age}", { age: clock.lasting(age) });
}

// Return a drive's frequency or setpoint in hertz, without its sign, or null if the value is old.
function hertz(name, part, at) {
  const register = key(name, part),
    found = register && reading(name, register, at);
  const isShown = found && found.value !== null && !found.isOld;
  return isShown && store.drives.get(name).registers.get(register).unit === "Hz"
    ? Math.abs(found.value)
    : null;
}

// Return the frequency at which a bar is full. It is the same for all drives, and null if no bars are drawn.
export function fullBar(at) {
  const shown = [...store.drives.keys()].flatMap(name => {
    const actual = hertz(name, "frequency", at);
    return actual === null ? [] : [actual, hertz(name, "setpoint", at) ?? 0];
  });
  if (!shown.length) return null;
  const most = shown.reduce((a, b) => Math.max(a, b));
  return FULL_HZ.find(hz => hz >= most) ?? most;
}

// Draw a drive's frequency and setpoint as a bar.
function drawBar(r, at, full) {
  const actual = hertz(r.name, "frequency", at),
    set = hertz(r.name, "setpoint", at);
  const length = value => `${(value / full) * 100}%`;
  r.bars.hidden = actual === null;
  r.set.hidden = set === null;
  if (r.bars.hidden) return;
  r.bar.style.width = length(actual);
  if (!r.set.hidden) r.set.style.left = length(set);
}

// Update a drive's row. `full` is the frequency, in hertz, at which a bar is full. Return true if the drive's
// state has changed.
export function drawRow(r, at, full) {
  const drive = store.frame?.drives[r.name],
    is = state(r.name),
    age = driveAge(r.name, at),
    own = store.drives.get(r.name);
  const changed = drawState(r, is, drive, age, at);
  const [frequency, current] = ["frequency", "current"].map(part => key(r.name, part));
  showValue(r.frequency, frequency && reading(r.name, frequency, at), own.registers.get(frequency));
  showValue(r.current, current && reading(r.name, current, at), own.registers.get(current), false);
  drawBar(r, at, full);
  put(r.age, age === null ? UNKNOWN : clock.lasting(age));
  const missed = drive?.missed ?? null;
  put(r.missed, missed === null ? UNKNOWN : missed === 0 ? "0" : share(missed));
  setClass(r.missed, "warn", missed >= MANY);
  setClass(r.missed, "none", missed === 0);
  return changed;
}

function drawState(r, is, drive, age, at) {
  const changed = r.state !== is;
  if (changed) {
    fill(r.shape, glyph(STATES[is] ? is : "unknown"));
    r.row.classList.remove(...Object.keys(STATES));
    r.row.classList.add(STATES[is] ? is : "unknown");
    r.state = is;
  }
  const word = stateWord(is, drive, age);
  put(r.word, isLive(at) || !store.frame ? word : t("last: {word}", { word }));
  const title = [word, said(noteOf(r.name))].filter(Boolean).join(": ");
  if (r.word.title !== title) r.word.title = title;
  return changed;
}

export function drawHead(h) {
  const line = store.frame?.lines[h.line.name];
  const { used = null, rate = null, planned = null, misses = null, lost = null } = line ?? {};
  put(h.share, ` ${showUse(h.bar, used, planned)}`);
  put(h.rate, rate === null ? "" : t("{n} exchanges/s", { n: rate.toFixed(1) }));
  put(
    h.missed,
    lost
      ? t("line lost: {why}", { why: said(lost) })
      : misses === null
        ? ""
        : misses
          ? t("{n} missed in the last minute", { n: misses })
          : t("none missed"),
  );
  const asked = rate === null ? 0 : rate * 60; // requests in the last minute
  setClass(h.missed, "lost", Boolean(lost));
  setClass(h.missed, "warn", Boolean(lost) || (misses > 1 && misses >= MANY * asked));
}
