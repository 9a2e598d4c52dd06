// Alarms as bars, drawn over the time axis of the trends.

import { endOf, readAlarms } from "../../data/history.js";
import { store } from "../../data/store.js";
import { said, t } from "../../texts.js";
import { fill, glyph, make, named } from "../../ui/dom.js";

const LANES = [
  [t("faults"), ["fault", "stopped", "limit"]],
  [t("silent"), ["silent", "port"]],
];
let serial = 0;

// Draw the drives' alarms between two times.
export async function draw(place, from, to, drives) {
  const mine = ++serial;
  if (!drives.length) {
    fill(place);
    return;
  }
  const [all, since] = await readAlarms(from, to),
    lines = drives.map(name => store.drives.get(name)?.line.name),
    alarms = all.filter(({ drive, line }) => (drive ? drives.includes(drive) : lines.includes(line)));
  if (mine !== serial) return;
  fill(
    place,
    LANES.map(([title, kinds]) => {
      const there = alarms.filter(alarm => kinds.includes(alarm.kind));
      return make(
        "div",
        { class: "lane" },
        make("b", {}, title),
        make(
          "div",
          { class: "bars" },
          since > from ? unknown(since, from, to) : null,
          there.map(alarm => bar(alarm, from, to)),
          there.length || since > from ? null : make("span", { class: "none" }, t("none")),
        ),
      );
    }),
  );
}

// Return a bar for the time before the gateway's start, because its alarms are unknown.
function unknown(since, from, to) {
  const text = t("unknown: the gateway started later"),
    shown = make("span", { class: "unknown", title: text }, text);
  shown.style.left = 0;
  shown.style.width = `${Math.min(1, (since - from) / (to - from)) * 100}%`;
  return shown;
}

function bar(alarm, from, to) {
  const who = alarm.drive || t("line {line}", { line: alarm.line }),
    what = said(alarm.text);
  const shown = make(
    "span",
    { class: alarm.kind, title: `${who}: ${what}` },
    glyph(alarm.kind),
    named(who),
    `: ${what}`,
  );
  const start = Math.max(0, (alarm.time - from) / (to - from)),
    end = Math.min(1, (endOf(alarm) - from) / (to - from));
  shown.style.left = `${start * 100}%`;
  shown.style.width = `${Math.max(0.3, (end - start) * 100)}%`;
  return shown;
}
