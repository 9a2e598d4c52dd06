// The view of the lines: used share of time compared with the plan, failed reads of the last hour by reason,
// response delays of each drive.

import { get } from "../data/api.js";
import { now } from "../data/link.js";
import { isLive, store } from "../data/store.js";
import { said, t } from "../texts.js";
import * as clock from "../ui/clock.js";
import { fill, find, glyph, make, named, tableHead } from "../ui/dom.js";
import { UNKNOWN, drives, makeUse, milliseconds, share, showUse } from "../ui/values.js";

const HOUR = 60; // number of minutes that are shown
const REASONS = ["c2", "c4", "c1", "c3", "c5", "c6"]; // colours of the reasons of failed reads

let shown = "";

// Fetch the data of the last hour, and draw the view again.
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
  const bar = makeUse();
  showUse(bar, used, planned);
  const pairs = [
    [t("Line time used"), [share(used), bar.whole]],
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

// Draw a bar of failed reads for each minute, stacked by reason, and a table with the sums of the hour.
function misses(minutes) {
  const sums = new Map();
  let asked = 0;
  for (const minute of minutes) {
    asked += minute.asked ?? 0;
    for (const [reason, n] of Object.entries(minute.misses)) sums.set(reason, (sums.get(reason) ?? 0) + n);
  }
  const reasons = [...sums.keys()].sort((a, b) => sums.get(b) - sums.get(a)),
    total = [...sums.values()].reduce((a, b) => a + b, 0);
  if (!minutes.length) return make("p", { class: "note" }, t("No full minute counted yet."));
  const head = make("h3", {}, t("Missed in the last hour: {n} of {all}", { n: total, all: asked }));
  if (!total) return make("section", {}, head);
  const most = Math.max(...minutes.map(m => Object.values(m.misses).reduce((a, b) => a + b, 0)));
  const newest = minutes[minutes.length - 1].time,
    began = Math.min(minutes[0].time, newest - (HOUR - 1) * 60000);
  return make(
    "section",
    {},
    head,
    make(
      "div",
      { class: "minutes", role: "img", "aria-label": t("Missed each minute, at most {n}", { n: most }) },
      Array.from({ length: HOUR - minutes.length }, () => make("div")),
      minutes.map(minute => column(minute, reasons, most)),
    ),
    make(
      "div",
      { class: "ends" },
      make("span", {}, `${clock.minute(began)} ${clock.zoneName()}`),
      make("span", {}, t("at most {n} a minute", { n: most })),
      make("span", {}, clock.minute(newest)),
    ),
    make(
      "table",
      { class: "plain" },
      tableHead([t("Reason"), t("Missed"), t("Share")]),
      make(
        "tbody",
        {},
        reasons.map((reason, i) =>
          make(
            "tr",
            {},
            make("th", { scope: "row" }, swatch(i), said(reason)),
            make("td", {}, String(sums.get(reason))),
            make("td", {}, share(asked ? sums.get(reason) / asked : null)),
          ),
        ),
      ),
    ),
  );
}

const reasonColour = i => `var(--${REASONS[i % REASONS.length]})`;

function column(minute, reasons, most) {
  const parts = reasons.map((reason, i) => {
    const part = make("i");
    part.style.height = `${((minute.misses[reason] ?? 0) / most) * 100}%`;
    part.style.background = reasonColour(i);
    return part;
  });
  const words =
    reasons
      .filter(r => minute.misses[r])
      .map(r => `${said(r)} ${minute.misses[r]}`)
      .join(", ") || t("none");
  return make("div", { title: `${clock.minute(minute.time)}: ${words}` }, parts);
}

function swatch(i) {
  const mark = make("i", { class: "swatch", "aria-hidden": "true" });
  mark.style.background = reasonColour(i);
  return mark;
}
