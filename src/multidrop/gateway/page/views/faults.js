// The view of active and ended alarms: faults, motors that stopped without a command, lost ports, silent
// drives.

import { endOf, readAlarms } from "../data/history.js";
import { now } from "../data/link.js";
import { isLive, store } from "../data/store.js";
import { pieces, said, t } from "../texts.js";
import * as clock from "../ui/clock.js";
import { confirmForm, send, tell } from "../ui/dialog.js";
import { fill, find, glyph, make, named, tableHead } from "../ui/dom.js";
import { ALARMS } from "../ui/values.js";

const SPAN_MS = 30 * 86400e3;
const AROUND_MS = 15 * 60e3;
const MOST_NOTE = 500; // characters of a note

let shown = "",
  shownAt = 0;

export function begin() {
  fill(
    find("#faults"),
    make(
      "div",
      { class: "card" },
      make("h2", {}, t("Alarms")),
      make(
        "p",
        { class: "note" },
        t("Active alarms, most serious first, and alarms that ended in the last 30 days."),
      ),
      make("div", { id: "fault-list", class: "scroll" }),
    ),
  );
}

// Redraw the list if it has changed.
export async function show() {
  const [found] = await readAlarms(now() - SPAN_MS, now()),
    sign = JSON.stringify([found, clock.zoneName()]),
    list = find("#fault-list");
  if (sign === shown && (now() - shownAt < 5000 || list.contains(document.activeElement))) return;
  [shown, shownAt] = [sign, now()];
  const kinds = Object.keys(ALARMS), // the most serious kind first
    rank = ({ kind, acknowledged }) => [acknowledged ? 1 : 0, kinds.indexOf(kind)].join(),
    lasting = found
      .filter(alarm => alarm.ended === null)
      .sort((a, b) => rank(a).localeCompare(rank(b)) || b.time - a.time),
    ended = found.filter(alarm => alarm.ended !== null);
  fill(
    list,
    part(t("Active: {n}", { n: lasting.length }), lasting),
    part(t("Ended: {n}", { n: ended.length }), ended),
  );
}

function part(title, alarms) {
  const since = t("Since, {zone}", { zone: clock.zoneName() }),
    heads = [since, t("Drive"), t("Kind"), t("Message"), t("Duration"), ""];
  return make(
    "section",
    {},
    make("h3", {}, title),
    alarms.length
      ? make("table", { class: "plain faults" }, tableHead(heads), make("tbody", {}, alarms.map(row)))
      : make("p", { class: "note" }, t("None.")),
  );
}

function row(alarm) {
  const { kind, drive, line, acknowledged } = alarm,
    isLasting = alarm.ended === null,
    began = clock.when(alarm.time);
  const where = drive ? `#/drives/${encodeURIComponent(drive)}` : "#/lines";
  return make(
    "tr",
    { class: isLasting && !acknowledged ? kind : "" },
    make("td", {}, alarm.is_before ? t("before {time}", { time: began }) : began),
    make("td", { class: "who" }, make("a", { href: where }, named(drive || t("line {line}", { line })))),
    make("td", { class: "kind" }, glyph(kind), ` ${ALARMS[kind] ?? kind}`),
    make("td", { class: "words" }, make("bdi", {}, said(alarm.text)), acknowledgement(alarm)),
    make("td", {}, lasted(alarm)),
    make("td", { class: "acts" }, acknowledged ? null : acknowledgeButton(alarm), trendLink(alarm)),
  );
}

// Return how long an alarm has lasted. The time is frozen while the gateway does not answer.
function lasted({ time, ended, is_before: isBefore }) {
  const at = now(),
    isNew = isLive(at) || store.frame === null, // before the first frame the fetched list counts as fresh
    seen = ended ?? (isNew ? at : store.time),
    age = isBefore ? t("over {age}", { age: clock.lasting(seen - time) }) : clock.lasting(seen - time);
  return ended === null ? t("{age} so far", { age }) : age;
}

function acknowledgement({ acknowledged, by, note }) {
  if (!acknowledged) return null;
  const words = note ? `: ${note}` : "";
  return make(
    "p",
    { class: "note" },
    pieces("acknowledged {time} by {user}", { time: clock.when(acknowledged), user: named(by) }),
    make("bdi", {}, words),
  );
}

const acknowledgeButton = alarm =>
  make("button", { type: "button", onclick: () => acknowledge(alarm) }, t("Acknowledge"));

function trendLink(alarm) {
  const { drive, time } = alarm;
  if (!drive) return null;
  const [from, to] = [Math.floor(time - AROUND_MS), Math.ceil(endOf(alarm) + AROUND_MS)];
  return make(
    "a",
    { href: `#/trends?drive=${encodeURIComponent(drive)}&from=${from}&to=${to}` },
    t("Trend"),
  );
}

// Ask the user for a note, and acknowledge an alarm with it.
async function acknowledge({ id, drive, line, text }) {
  const field = make("input", { id: "ack-note", maxlength: MOST_NOTE, "data-first": true });
  const contents = [
    make("p", {}, named(drive || t("line {line}", { line })), ": ", named(said(text))),
    make("label", { class: "field", for: "ack-note" }, t("Note (optional)"), field),
  ];
  if (!(await confirmForm(t("Acknowledge this alarm?"), contents, t("Acknowledge")))) return;
  try {
    await send("api/acknowledge", () => ({ alarm: id, note: field.value.trim() }));
  } catch (error) {
    await tell(t("The alarm was not acknowledged"), [make("p", { class: "bad" }, error.message)]);
  }
  await show();
}
