// Faults, silences and lost ports: those that last, and those that ended.

import { get, query } from "./api.js";
import * as clock from "./clock.js";
import { fill, find, glyph, make, named, tableHead } from "./dom.js";
import { now } from "./link.js";
import { alarms, isLive, store } from "./store.js";

const WORDS = { fault: "fault", silent: "silent", port: "port lost" };
const SPAN_MS = 30 * 86400e3;
const AROUND_MS = 15 * 60e3;

let shown = "",
  shownAt = 0;

// Return what was wrong between two times, newest first: as the gateway remembers it, or as the frame has it;
// and since when the gateway knows of all, null where it does not say.
export async function read(from, to) {
  const known = alarms();
  try {
    const told = await get(`api/alarms?${query({ from: Math.floor(from), to: Math.ceil(to) })}`);
    return [known.filter(alarm => alarm.kind === "port").concat(told.alarms), told.since];
  } catch {
    return [known.filter(alarm => (alarm.ended ?? Infinity) > from && alarm.time < to), null];
  }
}

export function begin() {
  fill(
    find("#faults"),
    make(
      "div",
      { class: "card" },
      make("h2", {}, "Faults and silences"),
      make(
        "p",
        { class: "note" },
        "What lasts, and what ended in the last 30 days since the gateway began.",
      ),
      make("div", { id: "fault-list", class: "scroll" }),
    ),
  );
}

// Draw the list anew, where it is another one.
export async function show() {
  const [found] = await read(now() - SPAN_MS, now()),
    sign = JSON.stringify([found, clock.zoneName()]),
    list = find("#fault-list");
  if (sign === shown && (now() - shownAt < 5000 || list.contains(document.activeElement))) return;
  [shown, shownAt] = [sign, now()];
  const lasting = found.filter(alarm => alarm.ended === null),
    ended = found.filter(alarm => alarm.ended !== null);
  fill(list, part(`Lasting: ${lasting.length}`, lasting), part(`Ended: ${ended.length}`, ended));
}

function part(title, alarms) {
  const heads = [`Since, ${clock.zoneName()}`, "Drive", "Kind", "What was said", "Lasted", ""];
  return make(
    "section",
    {},
    make("h3", {}, title),
    alarms.length
      ? make(
          "table",
          { class: "plain faults" },
          tableHead(heads),
          make("tbody", {}, alarms.map(row)),
        )
      : make("p", { class: "note" }, "None."),
  );
}

function row(alarm) {
  const { kind } = alarm,
    isLasting = alarm.ended === null;
  const from = Math.floor(alarm.time - AROUND_MS),
    to = Math.ceil((alarm.ended ?? now()) + AROUND_MS);
  const where = alarm.drive ? `#/drives/${encodeURIComponent(alarm.drive)}` : "#/lines";
  const t = now(),
    isNew = isLive(t) || store.frame === null, // before the first frame the gateway has just told the list
    seen = alarm.ended ?? (isNew ? t : store.time), // of a dead gateway nothing lasts on
    lasted = `${clock.lasting(seen - alarm.time)}${isLasting ? " so far" : ""}`;
  return make(
    "tr",
    { class: isLasting ? kind : "" },
    make("td", {}, alarm.time === null ? "–" : clock.when(alarm.time)),
    make("td", { class: "who" }, make("a", { href: where }, named(alarm.drive ?? alarm.line))),
    make("td", { class: "kind" }, glyph(kind), ` ${WORDS[kind]}`),
    make("td", { class: "words" }, make("bdi", {}, alarm.text)),
    make("td", {}, alarm.time === null ? "" : lasted),
    make(
      "td",
      {},
      alarm.drive
        ? make(
            "a",
            { href: `#/trends?drive=${encodeURIComponent(alarm.drive)}&from=${from}&to=${to}` },
            "Trend",
          )
        : "",
    ),
  );
}
