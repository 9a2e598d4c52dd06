// Faults and silences as bars over the time that the trends show.

import { fill, glyph, make, named } from "./dom.js";
import { read } from "./faults.js";
import { now } from "./link.js";

const KINDS = [
  ["fault", "faults"],
  ["silent", "silent"],
];
let serial = 0;

// Draw the alarms of these drives between two times into a place.
export async function draw(place, from, to, drives) {
  const mine = ++serial;
  if (!drives.length) {
    fill(place);
    return;
  }
  const [all, since] = await read(from, to),
    alarms = all.filter(alarm => drives.includes(alarm.drive));
  if (mine !== serial) return;
  fill(
    place,
    KINDS.map(([kind, title]) => {
      const there = alarms.filter(
        alarm => alarm.kind === kind && (alarm.ended ?? now()) > from && alarm.time < to,
      );
      return make(
        "div",
        { class: "lane" },
        make("b", {}, title),
        make(
          "div",
          { class: "bars" },
          since > from ? unknown(since, from, to) : null,
          there.map(alarm => bar(alarm, from, to)),
          there.length || since > from ? null : make("span", { class: "none" }, "none known"),
        ),
      );
    }),
  );
}

// Return a bar over the time of which the gateway, which began later, knows nothing.
function unknown(since, from, to) {
  const text = "not known: the gateway began later",
    shown = make("span", { class: "unknown", title: text }, text);
  shown.style.left = 0;
  shown.style.width = `${Math.min(1, (since - from) / (to - from)) * 100}%`;
  return shown;
}

function bar(alarm, from, to) {
  const text = `${alarm.drive}: ${alarm.text}`;
  const shown = make(
    "span",
    { class: alarm.kind, title: text },
    glyph(alarm.kind),
    named(alarm.drive),
    `: ${alarm.text}`,
  );
  const start = Math.max(0, (alarm.time - from) / (to - from)),
    end = Math.min(1, ((alarm.ended ?? now()) - from) / (to - from));
  shown.style.left = `${start * 100}%`;
  shown.style.width = `${Math.max(0.3, (end - start) * 100)}%`;
  return shown;
}
