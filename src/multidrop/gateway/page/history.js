// The recorded history: series of a time range, and links to download them.

import { get, query } from "./api.js";
import { holdsFor } from "./store.js";
import { unit } from "./values.js";

export const label = (drive, register) => `${drive}.${register}`;

const COLUMNS = ["time", "least", "mean", "most", "missed"];

// Return {series: {label: {time, least, mean, most}}, step_ms}. A null is a gap: a value was missed, or the
// register was not polled for longer than a value stays current. Throws Refused if no history is kept.
export async function read(labels, from, to, points) {
  const told = await get(
    `api/history?${query([
      ...labels.map(name => ["series", name]),
      ["from", Math.floor(from)],
      ["to", Math.ceil(to)],
      ["points", points],
    ])}`,
  );
  for (const [name, series] of Object.entries(told.series)) {
    const dot = name.lastIndexOf("."),
      longest = holdsFor(name.slice(0, dot), name.slice(dot + 1)) + told.step_ms;
    told.series[name] = { ...series, ...withoutPauses(series, longest) };
  }
  return told;
}

// A register may be polled less often than the plot has points: empty points between two values are no gap.
function withoutPauses(series, longest) {
  const kept = [];
  let pause = [],
    before = -Infinity;
  const keepLong = at => {
    if (at - before > longest) kept.push(...pause);
    pause = [];
  };
  for (const [i, at] of series.time.entries()) {
    if (series.mean[i] === null && !series.missed[i]) pause.push(i);
    else {
      keepLong(at);
      kept.push(i);
      before = at;
    }
  }
  keepLong(series.time.at(-1));
  return Object.fromEntries(COLUMNS.map(column => [column, kept.map(i => series[column][i])]));
}

// Return the unit in which a series was recorded; the name may have meant another drive then.
export const unitOf = (told, spec) => told.unit ?? unit(spec);

// Return true if a series has the present unit of its register.
export const isPresent = (told, spec) => unitOf(told, spec) === unit(spec);

// Return a sentence for each series that has a part in another unit; such parts are not drawn.
export const leftOut = series =>
  Object.entries(series)
    .filter(([, told]) => told.left_out?.length)
    .map(([name, told]) => {
      const others = told.left_out.map(other => other || "no unit").join(", ");
      return `${name} was also recorded in ${others}; that is not drawn.`;
    });

export const exportLink = (labels, from, to, format) =>
  `api/export?${query([
    ...labels.map(name => ["series", name]),
    ["from", Math.floor(from)],
    ["to", Math.ceil(to)],
    ["format", format],
  ])}`;
