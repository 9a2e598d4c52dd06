// The recorded history: values and alarms of a time range, and links to download values.

import { said, t } from "../texts.js";
import { unit } from "../ui/values.js";
import { Refused, get, query } from "./api.js";
import { now } from "./link.js";
import { alarms, holdsFor, store, withMs } from "./store.js";

export const label = (drive, register) => `${drive}.${register}`;

const COLUMNS = ["time", "least", "mean", "most", "missed"];

// Fetch recorded values. Return {series: {label: {time, least, mean, most}}, step_ms}. A null is a gap: a
// read failed, or the register was not polled for longer than a value stays current. Throws Refused if the
// gateway keeps no history.
export async function read(labels, from, to, points) {
  if (!store.plant.history)
    throw new Refused(0, t("No history is kept: the plant file has no [serve.history]."));
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

// Remove empty points between two values. A register may be polled less often than the plot has points, so
// such points are only a gap if they last longer than `longest`.
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

// Return the unit in which values were recorded. The register's name may have meant another drive's register
// then.
export const unitOf = (told, spec) => told.unit ?? unit(spec);

// Return true if values were recorded in the present unit of their register.
export const isPresent = (told, spec) => unitOf(told, spec) === unit(spec);

// Return sentences about missing curves: one for each register with values in another unit, which are not
// drawn. If there is none and no register has any value, return a sentence that says so.
export function notes(series) {
  const found = Object.entries(series),
    mixed = found.filter(([, told]) => told.left_out?.length);
  if (found.length && !mixed.length && found.every(([, { mean }]) => mean.every(value => value === null)))
    return [t("The history has no values in this time range.")];
  return mixed.map(([name, told]) => {
    const others = told.left_out.map(other => said(other) || t("no unit")).join(", ");
    return t("{series} was also recorded in {units}; that is not drawn.", { series: name, units: others });
  });
}

export const exportLink = (labels, from, to, format) =>
  `api/export?${query([
    ...labels.map(name => ["series", name]),
    ["from", Math.floor(from)],
    ["to", Math.ceil(to)],
    ["format", format],
  ])}`;

// Return the alarms between two times, newest first. They come from the gateway, or from the newest frame if
// the request fails. Also return the time from which the gateway knows all alarms, or null if that is
// unknown.
export async function readAlarms(from, to) {
  try {
    const told = await get(`api/alarms?${query({ from: Math.floor(from), to: Math.ceil(to) })}`);
    told.alarms.forEach(withMs);
    return [told.alarms, Date.parse(told.since)];
  } catch {
    return [alarms().filter(alarm => endOf(alarm) > from && alarm.time < to), null];
  }
}

// Return an alarm's end, or the present time for an active alarm. If the clock was set back during the alarm,
// the start counts as the end.
export const endOf = alarm => Math.max(alarm.time, alarm.ended ?? now());
