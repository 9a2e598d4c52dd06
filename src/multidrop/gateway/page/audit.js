// The audit log: every write that was sent, who asked for it, and what became of it.

import { get, query } from "./api.js";
import * as clock from "./clock.js";
import { fill, find, glyph, make, named, tableHead } from "./dom.js";

const COUNT = 100;
const DONE = /^(ok|confirmed|done|written|unchanged)/i;

let entries = [],
  more = false;

export function begin() {
  fill(
    find("#log"),
    make(
      "div",
      { class: "card" },
      make("h2", {}, "Audit log"),
      make("p", { class: "note" }, "Every write that was sent, newest first."),
      make("div", { id: "log-list", class: "scroll" }),
      make("button", { type: "button", id: "older", hidden: true, onclick: older }, "Older"),
    ),
  );
}

// Ask for the newest entries and draw them. Those that were asked for as older go.
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
      entries.length ? auditRows(entries, true) : make("p", { class: "note" }, "Nothing was written yet."),
    );
  } catch (error) {
    fill(list, make("p", { class: "note bad" }, error.message));
  }
  find("#older").hidden = !more;
}

// Draw what is shown anew, in another time zone.
export const redraw = () => entries.length && fill(find("#log-list"), auditRows(entries, true));

// Return a table of entries; `isWhole`: with the drive and the frame too.
export function auditRows(list, isWhole) {
  const heads = [
    `Time, ${clock.zoneName()}`,
    isWhole && "Drive",
    "Write",
    "Became",
    "By",
    isWhole && "Sent",
  ].filter(Boolean);
  return make(
    "table",
    { class: "plain audit" },
    tableHead(heads),
    make(
      "tbody",
      {},
      list.map(entry => row(entry, isWhole)),
    ),
  );
}

function row({ time, drive, address, model, write, sent, outcome, held, why, by, way }, isWhole) {
  const isDone = DONE.test(outcome ?? ""),
    became = [outcome ?? "unknown", held !== undefined && held !== null && `the drive holds ${held}`, why]
      .filter(Boolean)
      .join("; ");
  return make(
    "tr",
    {},
    make("td", { title: time }, clock.when(Date.parse(time))),
    isWhole ? make("td", { class: "who" }, drive ? named(drive) : `${model ?? ""} ${address ?? ""}`) : null,
    make("td", { class: "words" }, make("bdi", {}, String(write ?? "–"))),
    make("td", { class: isDone ? "words" : "words bad" }, isDone ? null : glyph("fault"), ` ${became}`),
    make("td", { class: "words" }, by ? named(by) : (way ?? "–")),
    isWhole ? make("td", { class: "frame" }, String(sent ?? "–")) : null,
  );
}
