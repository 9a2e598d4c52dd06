// Plots made with the library uPlot: theme, axes, and one time axis for registers with different sample
// times.

import { t } from "../texts.js";
import * as clock from "./clock.js";
import { colour, make } from "./dom.js";
import { number } from "./values.js";

export const COLOURS = ["c1", "c2", "c3", "c4", "c5", "c6"];
export const DASHES = [[], [6, 4], [2, 3], [10, 3, 2, 3]];
const RIGHT = 28; // px: half the width of a time label at the end
const FONT = "11px system-ui, DejaVu Sans, sans-serif";

export const isThere = () => Boolean(globalThis.uPlot);

// Return a function that gives a value axis its range, with a margin, and at least `least` wide so that noise
// does not fill the plot.
export const wide = least => (_, low, high) => {
  if (low === null || high === null) return [0, 1];
  const margin = Math.max((high - low) * 0.12, least);
  return [low - margin, high + margin];
};

// Return an axis number as the page writes all numbers: with a decimal point, without groups of digits.
const plain = value => (value === null ? null : String(Number(value.toPrecision(12))));

// Return a plot. `options` may have series, height, bands, range, hasTimes, cursor, hooks; times are in s.
export function makePlot(
  into,
  data,
  { series, height, bands = [], range = wide(0.5), hasTimes = true, cursor = {}, hooks = {}, sync, window },
) {
  const line = { stroke: colour("grid"), width: 1 };
  const axis = { stroke: colour("dim"), grid: line, ticks: line, font: FONT };
  return new globalThis.uPlot(
    {
      width: Math.max(120, into.clientWidth),
      height,
      padding: [6, RIGHT, hasTimes ? 0 : 6, 0],
      legend: { show: false },
      bands,
      hooks,
      tzDate: clock.tickDate,
      cursor: { sync: { key: sync }, points: { size: 6 }, drag: { x: false, y: false }, ...cursor },
      scales: { x: { time: true, range: window }, y: { range } },
      axes: [
        {
          ...axis,
          show: hasTimes,
          size: 26,
          space: 76,
          values: (_, splits, _axis, _space, step) => clock.ticks(splits, step),
        },
        { ...axis, size: 48, space: 26, values: (_, splits) => splits.map(plain) },
      ],
      series: [{}, ...series],
    },
    data,
    into,
  );
}

// Return the indices of isolated values. A value with a gap on both sides has no line, so it needs a dot.
// Such values occur if a register is read less often than the plot has points.
export function alone({ data }, k) {
  const places = [...data[k].keys()].filter(i => data[k][i] !== undefined), // skip times of other series
    isGap = n => (data[k][places[n]] ?? null) === null;
  return places.filter((_, n) => !isGap(n) && isGap(n - 1) && isGap(n + 1));
}

// Return the newest value of a column at a time (s), or null if that value is older than `holdMs`. Registers
// are read one after the other, so at the time of one register's sample the other columns have no value.
export function heldAt({ data }, column, time, holdMs) {
  const times = data[0],
    values = data[column];
  let i = times.findLastIndex(at => at <= time);
  while (i >= 0 && values[i] === undefined) i--;
  return i >= 0 && (time - times[i]) * 1000 <= holdMs ? values[i] : null;
}

// Return the dash pattern of the curve with this index. Neighbours differ in pattern and colour, and the
// first 24 curves have different combinations.
export const dashes = index => DASHES[(index + Math.floor(index / 12)) % DASHES.length];

// Return uPlot's options of a curve, in the colour of this index.
export const line = (index, label, dash = []) => ({
  label,
  stroke: colour(COLOURS[index % COLOURS.length]),
  width: 1.5,
  dash,
  points: { show: false, filter: alone, size: 4, fill: (u, k) => u.series[k].stroke(u, k) },
});

// Return the translucent colour of the area between least and largest value of the curve with this index.
export const translucent = (index, alpha) =>
  colour(COLOURS[index % COLOURS.length])
    .replace("rgb(", "rgba(")
    .replace(")", `, ${alpha})`);

// Return an element for the legend: a short piece of the curve with this index.
export function swatch(index) {
  const mark = make("canvas", { class: "swatch", width: 28, height: 6, "aria-hidden": "true" }),
    pen = mark.getContext("2d");
  [pen.strokeStyle, pen.lineWidth] = [colour(COLOURS[index % COLOURS.length]), 3];
  pen.setLineDash(dashes(index));
  pen.beginPath();
  pen.moveTo(0, 3);
  pen.lineTo(28, 3);
  pen.stroke();
  return mark;
}

// Merge several [times in ms, column, column …] into one table of times (s) and columns.
export function join(tables) {
  const there = tables.map(([times, ...columns]) => [times.map(ms => ms / 1000), ...columns]);
  return there.length === 1 ? there[0] : globalThis.uPlot.join(there);
}

// Return a sentence that describes a curve's values for screen readers.
export function summary(what, values, unit, digits) {
  const there = values.filter(value => value !== null && value !== undefined);
  if (!there.length) return t("{what}: no values", { what });
  const low = there.reduce((a, b) => Math.min(a, b)),
    high = there.reduce((a, b) => Math.max(a, b));
  const [from, to, last] = [low, high, there[there.length - 1]].map(value => number(value, digits));
  return t("{what}: {from} to {to} {unit}, last {last} {unit}", { what, from, to, last, unit });
}
