// The view of trends: recorded values over any time range, with zoom, markers, alarms, and files to export.

import { exportLink, label, notes, read, unitOf } from "../../data/history.js";
import { now } from "../../data/link.js";
import { onPlant, store } from "../../data/store.js";
import { t } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { confirmForm } from "../../ui/dialog.js";
import { fill, find, make, put } from "../../ui/dom.js";
import { isThere } from "../../ui/plots.js";
import { draw as drawLane } from "./lane.js";
import * as markers from "./markers.js";
import * as picker from "./picker.js";
import { makeTrend } from "./plot.js";
import * as triggers from "./triggers.js";

const RANGES = [
  [900, t("{n} min", { n: 15 })],
  [3600, t("{n} h", { n: 1 })],
  [8 * 3600, t("{n} h", { n: 8 })],
  [86400, t("{n} h", { n: 24 })],
  [7 * 86400, t("{n} days", { n: 7 })],
];
const LEAST_MS = 1000;
const ANEW_MS = 5000;
const SETTLE_MS = 150; // delay before a fetch, so that of several clicks only the last is fetched

const view = { from: 0, to: 0, follows: true, back: [] };
let plots = [],
  told = null,
  waiting = null,
  serial = 0,
  isShown = false,
  isDragged = false, // true while the mouse drags over a plot: the plot must not be rebuilt
  isDue = false; // the plots must be drawn when the mouse button is released

export function begin() {
  onPlant(() => {
    picker.takePlant();
    if (isShown) ask();
  });
  const buttons = RANGES.map(([seconds, name]) =>
    make("button", { type: "button", "data-seconds": seconds, onclick: () => last(seconds) }, name),
  );
  const steps = [
    ["◀", t("Earlier"), () => pan(-0.5)],
    ["▶", t("Later"), () => pan(0.5)],
    ["−", t("Zoom out"), () => zoom(2)],
    ["+", t("Zoom in"), () => zoom(0.5)],
    [t("Back"), t("Back to the previous range"), back],
  ];
  fill(
    find("#trends"),
    make("div", { class: "card picker", id: "picker" }),
    make(
      "div",
      { class: "card plots" },
      make(
        "div",
        { class: "ranges", role: "group", "aria-label": t("Time range") },
        buttons,
        steps.map(([sign, name, what]) =>
          make("button", { type: "button", "aria-label": name, title: name, onclick: what }, sign),
        ),
        triggers.begin(set, ask),
        markers.buttons(),
        make("button", { class: "span", id: "span", type: "button", title: t("Dates"), onclick: askDates }),
        make("a", { id: "csv", download: true }, "CSV"),
        make("a", { id: "parquet", download: true }, "Parquet"),
      ),
      make("p", { class: "note", id: "trend-note", hidden: true }),
      make("div", { id: "lane" }),
      make("div", { id: "trend-plots" }),
      make("div", { id: "marks" }),
    ),
  );
  find("#trend-plots").addEventListener("mousedown", () => (isDragged = true));
  for (const end of ["mouseup", "blur"]) addEventListener(end, letGo); // runs after the plots' own listeners
  picker.begin(find("#picker"), ask);
  markers.begin(
    () => plots,
    () => view,
  );
}

// Show the view. Its link may name a drive and a time range.
export function show(options) {
  isShown = true;
  if (options.get("drive")) picker.choose(options.get("drive"));
  if (options.get("from")) set(Number(options.get("from")), Number(options.get("to")), false);
  else if (!view.to || view.follows) last((view.to - view.from) / 1000 || 3600);
  ask();
  triggers.watch(true);
}

export function hide() {
  isShown = false;
  triggers.watch(false);
  serial++;
}

function set(from, to, follows) {
  const isSame = Math.abs(from - view.from) + Math.abs(to - view.to) < (view.to - view.from) / 1000;
  if (isSame && !follows) return; // all plots report the same drag of the mouse
  triggers.leave();
  if (view.to) view.back.push([view.from, view.to, view.follows]);
  view.back.splice(0, view.back.length - 50);
  Object.assign(view, { from, to: Math.max(to, from + LEAST_MS), follows });
  ask();
}

const last = seconds => set(now() - seconds * 1000, now(), true);
const pan = part => {
  const by = (view.to - view.from) * part;
  set(view.from + by, view.to + by, false);
};
const zoom = by => {
  const middle = (view.from + view.to) / 2,
    half = ((view.to - view.from) / 2) * by;
  set(middle - half, middle + half, false);
};

// Ask for two dates in a dialog, and show the time range between them.
async function askDates() {
  const [from, to] = [
    ["dates-from", view.from],
    ["dates-to", view.to],
  ].map(([id, ms]) =>
    make("input", { id, type: "datetime-local", step: 1, required: true, value: clock.field(ms) }),
  );
  from.dataset.first = "";
  const check = () =>
    to.setCustomValidity(
      clock.parsed(to.value) > clock.parsed(from.value) ? "" : t("The end must be after the start."),
    );
  for (const field of [from, to]) field.addEventListener("input", check);
  const contents = [
    make("label", { class: "field", for: from.id }, t("From, {zone}", { zone: clock.zoneName() }), from),
    make("label", { class: "field", for: to.id }, t("To, {zone}", { zone: clock.zoneName() }), to),
  ];
  if (await confirmForm(t("Time range"), contents, t("Show"), ""))
    set(clock.parsed(from.value), clock.parsed(to.value), false);
}

export function back() {
  const before = view.back.pop();
  if (!before) return;
  [view.from, view.to, view.follows] = before;
  triggers.leave();
  ask();
}

// Fetch the selected registers' values after SETTLE_MS, unless this is called again before.
function ask() {
  clearTimeout(waiting);
  showSpan();
  waiting = setTimeout(fetchAll, SETTLE_MS);
}

function showSpan() {
  put(find("#span"), `${clock.moment(view.from)} – ${clock.moment(view.to)} ${clock.zoneName()}`);
  const length = Math.round((view.to - view.from) / 1000);
  for (const button of document.querySelectorAll("#trends .ranges [data-seconds]")) {
    button.setAttribute("aria-pressed", view.follows && Number(button.dataset.seconds) === length);
  }
  const labels = wanted();
  for (const format of ["csv", "parquet"]) {
    const anchor = find(`#${format}`);
    if (labels.length) anchor.href = exportLink(labels, view.from, view.to, format);
    else anchor.removeAttribute("href");
  }
}

const wanted = () =>
  picker.quantities().flatMap(register =>
    picker
      .drives()
      .filter(name => picker.isPolled(name, register))
      .map(name => label(name, register)),
  );

async function fetchAll() {
  const mine = ++serial,
    labels = wanted();
  if (!isShown || !store.plant) return;
  drawLane(find("#lane"), view.from, view.to, picker.showsFaults() ? picker.drives() : []);
  let note = labels.length ? "" : t("Select a drive and a quantity.");
  told = { series: {} };
  try {
    if (labels.length)
      told = await read(labels, view.from, view.to, Math.max(200, find("#trend-plots").clientWidth));
  } catch (error) {
    note = error.message;
  }
  if (mine !== serial || !isShown) return;
  note = [triggers.note(), note, ...notes(told.series)].filter(Boolean).join(" ");
  put(find("#trend-note"), note);
  find("#trend-note").hidden = note === "";
  draw();
  if (view.follows) {
    waiting = setTimeout(
      () => {
        const length = view.to - view.from;
        if (view.follows && isShown) {
          [view.from, view.to] = [now() - length, now()];
          showSpan();
          fetchAll();
        }
      },
      Math.max(ANEW_MS, told.step_ms ?? 0),
    );
  }
}

function letGo() {
  isDragged = false;
  if (isDue) draw();
}

// Draw the data that were fetched last. Called again after a change of size, theme or time zone.
export function draw() {
  isDue = isDragged;
  if (isDue) return;
  for (const { plot } of plots) plot.destroy();
  plots = [];
  const place = find("#trend-plots");
  fill(place);
  if (!isShown || !told || !isThere()) return;
  const shown = parted();
  const around = { view, set, count: shown.length, stepMs: told.step_ms };
  for (const one of shown) plots.push(makeTrend(place, one, told.series, around));
  markers.draw();
}

// Return the register, unit and drives of each plot. Drives with different units need different plots.
function parted() {
  const found = new Map();
  for (const register of picker.quantities())
    for (const name of picker.drives()) {
      const series = told.series[label(name, register)];
      if (!series) continue;
      const unit = unitOf(series, store.drives.get(name).registers.get(register)),
        key = JSON.stringify([register, unit]);
      if (!found.has(key)) found.set(key, { register, unit, drives: [] });
      found.get(key).drives.push(name);
    }
  return [...found.values()];
}
