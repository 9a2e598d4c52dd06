// The lines: wire used against plan, misses by reason over the last hour, delays of each drive.

import { get } from "../data/api.js";
import { now } from "../data/link.js";
import { isLive, store } from "../data/store.js";
import { said, t } from "../texts.js";
import * as clock from "../ui/clock.js";
import { fill, find, glyph, make, named, tableHead } from "../ui/dom.js";
import { drives, milliseconds, share, UNKNOWN } from "../ui/values.js";
import { misses } from "./misses.js";

let shown = "";

// Fetch the last hour and redraw everything.
export async function show() {
  if (!store.plant) return;
  let told = {},
    error = null;
  try {
    told = await get("api/lines");
  } catch (problem) {
    error = problem.message;
  }
  const sign = JSON.stringify([told, error, clock.zoneName(), store.frame?.lines, isLive(now())]);
  if (sign === shown) return;
  shown = sign;
  fill(
    find("#lines"),
    error ? make("p", { class: "card note bad" }, error) : null,
    store.plant.lines.map(line => card(line, told[line.name])),
  );
}

function card(line, told) {
  const frame = store.frame?.lines[line.name] ?? {};
  return make(
    "article",
    { class: "card line", "aria-label": line.name },
    make("h2", {}, named(line.name)),
    make(
      "p",
      { class: "note" },
      [line.port, line.speed, drives(line.drives.length)].filter(Boolean).join(" · "),
    ),
    frame.lost
      ? make(
          "p",
          { class: "warn" },
          glyph("port"),
          ` ${t("The line is lost: {why}", { why: said(frame.lost) })}`,
        )
      : null,
    figures(frame),
    told ? misses(told.minutes) : null,
    delays(line, told?.drives ?? {}),
  );
}

function figures({ used = null, planned = null, rate = null, p99 = null, misses: missed = null }) {
  const isOver = used !== null && planned !== null && used > planned + 0.05;
  const bar = make("span", {
    class: "use",
    role: "img",
    "aria-label": t("{used} used, {planned} planned", { used: share(used), planned: share(planned) }),
  });
  const [part, mark] = [make("i"), make("u")];
  part.style.width = `${Math.min(1, used ?? 0) * 100}%`;
  mark.style.left = `${Math.min(1, planned ?? 0) * 100}%`;
  mark.hidden = planned === null;
  bar.append(part, mark);
  const pairs = [
    [t("Line time used"), [share(used), bar]],
    [
      t("Planned"),
      [share(planned), isOver ? make("small", { class: "warn" }, ` ${t("more than planned")}`) : null],
    ],
    [t("Exchanges"), [rate === null ? UNKNOWN : t("{n} /s", { n: rate.toFixed(1) })]],
    [t("Delay, 99 % within"), [milliseconds(p99)]],
    [
      t("Missed in the last minute"),
      [make("span", { class: missed > 0 ? "warn" : "" }, missed === null ? UNKNOWN : String(missed))],
    ],
  ];
  return make(
    "dl",
    { class: "keys" },
    pairs.map(([title, value]) => make("div", {}, make("dt", {}, title), make("dd", {}, value))),
  );
}

function delays(line, told) {
  const most = Math.max(1, ...Object.values(told).map(d => d?.p99 ?? 0));
  return make(
    "section",
    {},
    make("h3", {}, t("Response delay of each drive")),
    make(
      "div",
      { class: "scroll" },
      make(
        "table",
        { class: "plain delays" },
        tableHead([t("Drive"), t("50 % within"), t("99 % within"), "", t("Missed")]),
        make(
          "tbody",
          {},
          line.drives.map(({ name }) => {
            const d = told[name] ?? {},
              half = make("i"),
              tail = make("u"),
              bar = make("span", { class: "delay", "aria-hidden": "true" }, half, tail);
            half.style.width = `${((d.p50 ?? 0) / most) * 100}%`;
            tail.style.left = `${((d.p99 ?? 0) / most) * 100}%`;
            bar.hidden = d.p99 === null || d.p99 === undefined;
            return make(
              "tr",
              {},
              make(
                "th",
                { scope: "row" },
                make("a", { href: `#/drives/${encodeURIComponent(name)}` }, named(name)),
              ),
              make("td", {}, milliseconds(d.p50)),
              make("td", {}, milliseconds(d.p99)),
              make("td", {}, bar),
              make(
                "td",
                { class: d.missed ? "warn" : "" },
                d.asked
                  ? t("{n} of {all}, {share}", {
                      n: d.missed,
                      all: d.asked,
                      share: share(d.missed / d.asked),
                    })
                  : UNKNOWN,
              ),
            );
          }),
        ),
      ),
    ),
  );
}
