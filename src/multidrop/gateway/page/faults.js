// Faults, silences and lost ports: those that last, and those that ended.

import { get, query } from "./api.js";
import * as clock from "./clock.js";
import { fill, find, glyph, make, named } from "./dom.js";
import { now } from "./link.js";
import { store } from "./store.js";

const SPANS = [
  [3600e3, "1 h"],
  [86400e3, "24 h"],
  [7 * 86400e3, "7 days"],
  [30 * 86400e3, "30 days"],
];
const WORDS = { fault: "fault", silent: "silent", port: "port lost" };
const AROUND_MS = 15 * 60e3;

let span = 86400e3,
  shown = "",
  shownAt = 0;

// Return the alarms between two times, newest first: as the gateway kept them, or as the frame has them.
export async function read(from, to) {
  try {
    return (await get(`api/alarms?${query({ from: Math.floor(from), to: Math.ceil(to) })}`)).alarms;
  } catch {
    return (store.frame?.alarms ?? []).filter(alarm => (alarm.ended ?? Infinity) > from && alarm.time < to);
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
        "div",
        { class: "ranges", role: "group", "aria-label": "Span of time" },
        SPANS.map(([ms, name]) =>
          make(
            "button",
            { type: "button", "data-ms": ms, "aria-pressed": ms === span, onclick: () => choose(ms) },
            name,
          ),
        ),
      ),
      make("div", { id: "fault-list", class: "scroll" }),
    ),
  );
}

function choose(ms) {
  span = ms;
  for (const button of document.querySelectorAll("#faults .ranges button"))
    button.setAttribute("aria-pressed", Number(button.dataset.ms) === span);
  show();
}

// Draw the list anew.
export async function show() {
  const alarms = await read(now() - span, now());
  const sign = JSON.stringify([alarms, clock.zoneName(), span]),
    list = find("#fault-list");
  if (sign === shown && (now() - shownAt < 5000 || list.contains(document.activeElement))) return;
  [shown, shownAt] = [sign, now()];
  const lasting = alarms.filter(alarm => alarm.ended === null),
    ended = alarms.filter(alarm => alarm.ended !== null);
  fill(list, part(`Lasting: ${lasting.length}`, lasting), part(`Ended: ${ended.length}`, ended));
}

function part(title, alarms) {
  const heads = [`Since, ${clock.zoneName()}`, "Drive", "Kind", "In the drive's words", "Lasted", ""];
  return make(
    "section",
    {},
    make("h3", {}, title),
    alarms.length
      ? make(
          "table",
          { class: "plain faults" },
          make(
            "thead",
            {},
            make(
              "tr",
              {},
              heads.map((h, i) => (i === 5 ? make("td", {}) : make("th", { scope: "col" }, h))),
            ),
          ),
          make("tbody", {}, alarms.map(row)),
        )
      : make("p", { class: "note" }, "None."),
  );
}

function row(alarm) {
  const kind = WORDS[alarm.kind] ? alarm.kind : "fault",
    isLasting = alarm.ended === null;
  const from = Math.floor(alarm.time - AROUND_MS),
    to = Math.ceil((alarm.ended ?? now()) + AROUND_MS);
  const drive = alarm.drive
    ? make("a", { href: `#/drives/${encodeURIComponent(alarm.drive)}` }, named(alarm.drive))
    : "–";
  return make(
    "tr",
    { class: isLasting ? kind : "" },
    make("td", {}, clock.when(alarm.time)),
    make("td", { class: "who" }, drive),
    make("td", { class: "kind" }, glyph(kind), ` ${WORDS[kind]}`),
    make("td", { class: "words" }, make("bdi", {}, alarm.text)),
    make("td", {}, clock.lasting((alarm.ended ?? now()) - alarm.time) + (isLasting ? " so far" : "")),
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
