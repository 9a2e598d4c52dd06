// The view of the audit log: all writes, with who asked for them and their results.

import { get, query } from "../data/api.js";
import { said, t } from "../texts.js";
import * as clock from "../ui/clock.js";
import { fill, find, glyph, make, named, tableHead } from "../ui/dom.js";

const COUNT = 100;
const DONE = /^(ok|confirmed|done|written|unchanged|stopped|called)/i;

let entries = [],
  more = false;

export function begin() {
  fill(
    find("#log"),
    make(
      "div",
      { class: "card" },
      make("h2", {}, t("Audit log")),
      make("p", { class: "note" }, t("All writes sent, newest first.")),
      make("div", { id: "log-list", class: "scroll" }),
      make("button", { type: "button", id: "older", hidden: true, onclick: older }, t("Older")),
    ),
  );
}

// Fetch the newest entries, and draw them in place of the entries shown before.
export async function show() {
  [entries, more] = [[], false];
  await fetchMore("");
}

const older = () => fetchMore(entries.length ? entries[entries.length - 1].time : "");

async function fetchMore(before) {
  const list = find("#log-list");
  try {
    const told = await get(`api/audit?${query({ ...(before && { before }), count: COUNT })}`);
    entries = before ? entries.concat(told.entries) : told.entries;
    more = Boolean(told.more);
    fill(
      list,
      entries.length ? auditRows(entries, true) : make("p", { class: "note" }, t("No writes yet.")),
    );
  } catch (error) {
    fill(list, make("p", { class: "note bad" }, error.message));
  }
  find("#older").hidden = !more;
}

// Draw all entries again, because the time zone has changed.
export const redraw = () => entries.length && fill(find("#log-list"), auditRows(entries, true));

// Return a table of at most `most` entries. If `isWhole`, it also has columns for the drive and the Modbus
// frame.
export function auditRows(list, isWhole, most = Infinity) {
  const heads = [
    t("Time, {zone}", { zone: clock.zoneName() }),
    isWhole && t("Drive"),
    t("Write"),
    t("Result"),
    t("By"),
    isWhole && t("Sent"),
  ].filter(Boolean);
  return make(
    "table",
    { class: "plain audit" },
    tableHead(heads),
    make(
      "tbody",
      {},
      repeats(list)
        .slice(0, most)
        .map(entry => row(entry, isWhole)),
    ),
  );
}

// Return the entries with repetitions merged, because a stop is repeated until the drive confirms it. If
// successive commands to a drive and their results are equal, only the newest is returned, with their number
// in `times` and the time of the first in `since`.
function repeats(list) {
  const newest = new Map(),
    kept = [];
  for (const { time, drive, address, model, ...rest } of list) {
    const whose = JSON.stringify([drive, address, model]),
      what = JSON.stringify(rest),
      last = newest.get(whose);
    if (last?.what === what) {
      last.times += 1;
      last.since = time;
      continue;
    }
    kept.push({ ...rest, time, drive, address, model, what, times: 1, since: time });
    newest.set(whose, kept.at(-1));
  }
  return kept;
}

const at = time => clock.when(Date.parse(time));

const repeated = (times, since) =>
  make("p", { class: "note" }, t("{n} times since {time}", { n: times, time: at(since) }));

function row(entry, isWhole) {
  const { time, drive, address, model, write, sent, frames, outcome, held, why, by, way, times, since } =
    entry;
  const isDone = DONE.test(outcome ?? ""),
    result = [
      said(outcome ?? "unknown"),
      held !== undefined && held !== null && t("the drive holds {value}", { value: held }),
      frames > 1 && t("{n} frames", { n: frames }),
      why && said(why),
    ]
      .filter(Boolean)
      .join("; ");
  return make(
    "tr",
    {},
    make("td", { title: time }, at(time)),
    isWhole ? make("td", { class: "who" }, drive ? named(drive) : `${model ?? ""} ${address ?? ""}`) : null,
    make(
      "td",
      { class: "words" },
      make("bdi", {}, String(write ?? "–")),
      times > 1 ? repeated(times, since) : null,
    ),
    make("td", { class: isDone ? "words" : "words bad" }, isDone ? null : glyph("fault"), ` ${result}`),
    make("td", { class: "words" }, by ? named(by) : (way ?? "–")),
    isWhole ? make("td", { class: "frame" }, String(sent ?? "–")) : null,
  );
}
