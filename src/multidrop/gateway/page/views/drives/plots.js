// The plots of the chosen drive, with a common cursor: frequency and setpoint, electric current, and a
// register of choice.

import { exportLink, isPresent, label, notes, read } from "../../data/history.js";
import { now } from "../../data/link.js";
import { holdsFor, isLive, store } from "../../data/store.js";
import { t } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { colour, fill, find, make, put } from "../../ui/dom.js";
import {
  COLOURS,
  heldAt,
  isThere,
  join,
  line,
  makePlot,
  summary,
  translucent,
  wide,
} from "../../ui/plots.js";
import { registerName, text, title, unitName } from "../../ui/values.js";

const RANGES = [
  [10, t("{n} s", { n: 10 })],
  [60, t("{n} min", { n: 1 })],
  [600, t("{n} min", { n: 10 })],
  [3600, t("{n} h", { n: 1 })],
  [86400, t("{n} h", { n: 24 })],
];
const FROM_HISTORY = 600; // in s: longer ranges come from the history, shorter ones from frames
const ANEW_MS = 5000;
const POINTS = 400;
const SYNC = "panel";

let range = 60,
  spec = null,
  plots = [],
  third = null,
  past = null,
  serial = 0;

export function clear() {
  for (const { plot } of plots) plot?.destroy();
  [plots, spec, past] = [[], null, null];
  serial++;
}

// Make the buttons for time ranges, and empty elements for the plots. `begin` makes the plots once these
// elements are in the document.
export function build(drive) {
  const ranges = make(
    "div",
    { class: "ranges", role: "group", "aria-label": t("Time range") },
    RANGES.map(([seconds, name]) =>
      make(
        "button",
        {
          type: "button",
          "data-seconds": seconds,
          "aria-pressed": seconds === range,
          onclick: () => choose(seconds),
        },
        name,
      ),
    ),
    make(
      "span",
      { class: "links" },
      make("a", { id: "panel-csv", download: true }, "CSV"),
      make("a", { href: `#/trends?drive=${encodeURIComponent(drive.name)}` }, t("Trends")),
    ),
  );
  return make(
    "section",
    { "aria-label": t("Plots") },
    ranges,
    make("p", { class: "note", id: "past-note", hidden: true }),
    make("div", { id: "plots" }),
  );
}

function choose(seconds) {
  range = seconds;
  for (const button of document.querySelectorAll(".panel .ranges button"))
    button.setAttribute("aria-pressed", Number(button.dataset.seconds) === range);
  past = null;
  fetchPast();
  draw();
}

// Make the plots. Called when the drive's panel is in the document, and again when size, theme or time zone
// change.
export function begin(drive) {
  for (const { plot } of plots) plot?.destroy();
  spec = drive;
  plots = [];
  const place = find("#plots");
  if (!place) return;
  if (!isThere()) {
    fill(place, make("p", { class: "note" }, t("Plots could not be loaded.")));
    return;
  }
  fill(place);
  const { frequency, setpoint, current } = spec.key ?? {};
  const numbers = spec.registers.filter(r => r.kind === "number" && r.period_s !== null);
  const rest = numbers.filter(r => ![frequency, setpoint, current].includes(r.name));
  if (!rest.some(r => r.name === third))
    third = (rest.find(r => /torque|power/.test(r.name)) ?? rest[0])?.name ?? null;
  const isOneUnit = unitOf(frequency) === unitOf(setpoint);
  const first = isOneUnit ? [[frequency, setpoint]] : [[frequency], [setpoint]];
  const stack = [...first, [current], [third]]
    .map(names => names.filter(name => numbers.some(r => r.name === name)))
    .filter(names => names.length);
  plots = stack.map((names, i) =>
    one(place, names, i, i === stack.length - 1, names[0] === third ? rest : null),
  );
  past = null;
  fetchPast();
  draw();
}

const unitOf = name => spec.registers.find(r => r.name === name)?.unit;

function one(place, names, index, isLast, choices) {
  const specs = names.map(name => spec.registers.find(r => r.name === name));
  const out = make("output"),
    box = make("div", { class: "plotbox", role: "img" });
  const heads = specs.map((register, i) =>
    choices
      ? picker(choices)
      : make("span", { class: "legend" }, swatch(i ? null : index), title(register)),
  );
  place.append(
    make(
      "div",
      { class: "plot" },
      make("div", { class: "plothead" }, choices ? swatch(index) : null, heads, out),
      box,
    ),
  );
  const first = line(index, specs[0].name);
  const band = { stroke: "transparent", points: { show: false } };
  const series = [
    first,
    ...specs.slice(1).map(r => ({ ...line(0, r.name), stroke: colour("dim"), dash: [5, 4], width: 1.2 })),
    band,
    band,
  ];
  const plot = makePlot(box, [[], ...series.map(() => [])], {
    series,
    height: index === 0 ? 118 : isLast ? 112 : 92,
    hasTimes: isLast,
    range: wide(specs[0].unit === "Hz" ? 0.5 : 1),
    sync: SYNC,
    bands: [{ series: [series.length - 1, series.length], fill: translucent(index, 0.2) }],
    window: () => [(until() - range * 1000) / 1000, until() / 1000],
    hooks: { setCursor: [u => put(out, under(u, specs))] },
  });
  return { plot, specs, box };
}

function swatch(index) {
  const mark = make("i", { class: index === null ? "swatch dashed" : "swatch", "aria-hidden": "true" });
  if (index !== null) mark.style.background = `var(--${COLOURS[index]})`;
  return mark;
}

function picker(choices) {
  const select = make(
    "select",
    {
      "aria-label": t("Third plot"),
      onchange: event => {
        third = event.target.value;
        begin(spec);
      },
    },
    choices.map(r => make("option", { value: r.name }, title(r))),
  );
  select.value = third;
  return select;
}

function under(u, specs) {
  const i = u.cursor.idx;
  if (i === null || i === undefined || u.data[0][i] === undefined) return "";
  const stepMs = needsHistory() ? (range * 1000) / POINTS : 0;
  const values = specs
    .map((r, k) => text(heldAt(u, k + 1, u.data[0][i], holdsFor(spec.name, r.name) + stepMs), r))
    .join(" / ");
  return `${clock.time(u.data[0][i] * 1000)}  ${values}`;
}

const until = () => (isLive(now()) ? store.time : now());
const needsHistory = () => range > FROM_HISTORY;

// Fetch recorded values of the shown range. In a short range, fetch only those from before this page's first
// frame.
async function fetchPast() {
  const mine = ++serial,
    to = until(),
    from = to - range * 1000,
    asked = spec;
  const labels = plots.flatMap(({ specs }) => specs).map(r => label(asked.name, r.name));
  link(labels, from, to);
  let note = "";
  try {
    const told = await read(labels, from, to, POINTS);
    if (mine === serial) past = { series: told.series, until: to };
    if (needsHistory()) note = notes(told.series).join(" ");
  } catch (error) {
    if (needsHistory()) note = error.message;
  }
  if (mine !== serial) return;
  const place = find("#past-note");
  put(place, note);
  place.hidden = note === "";
  draw();
  if (needsHistory())
    setTimeout(() => {
      if (mine === serial && spec === asked) fetchPast();
    }, ANEW_MS);
}

function link(labels, from, to) {
  const csv = find("#panel-csv");
  if (csv && labels.length) csv.href = exportLink(labels, from, to, "csv");
}

// Draw the newest samples from frames. Longer ranges are drawn when their recorded values arrive.
export function draw() {
  for (const { plot, specs, box } of plots) {
    const tables = specs.map(r => samples(r));
    const joined = join(
      tables.map(one => one.slice(0, 2)).concat([[tables[0][0], tables[0][2], tables[0][3]]]),
    );
    plot.setData(joined);
    const words_ = summary(registerName(specs[0]), tables[0][1], unitName(specs[0]), specs[0].digits);
    if (box.getAttribute("aria-label") !== words_) box.setAttribute("aria-label", words_);
  }
}

// Return [times, values, largest, least] of a register over the shown range.
function samples(register) {
  const from = until() - range * 1000;
  const kept = past?.series?.[label(spec.name, register.name)],
    told = kept && isPresent(kept, register) ? kept : null;
  if (needsHistory()) return told ? [told.time, told.mean, told.most, told.least] : [[], [], [], []];
  const [times, values] = store.drives.get(spec.name)?.pasts.get(register.name)?.since(from) ?? [[], []];
  const first = times[0] ?? Infinity,
    earlier = (told?.time ?? []).findLastIndex(ms => ms < first) + 1;
  const before = [told?.time ?? [], told?.mean ?? []].map(column => column.slice(0, earlier));
  const joined = before[0].concat(times),
    none = joined.map(() => null);
  return [joined, before[1].concat(values), none, none];
}
