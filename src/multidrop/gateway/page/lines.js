// The lines: wire used against plan, misses by reason over the last hour, delays of each drive.

import { get } from "./api.js";
import * as clock from "./clock.js";
import { colour, fill, find, glyph, make, named } from "./dom.js";
import { isLive, store } from "./store.js";
import { now } from "./link.js";
import { milliseconds, share, UNKNOWN } from "./values.js";

const REASONS = ["c2", "c4", "c1", "c3", "c5", "c6"];

let shown = "";

// Ask for the hour and draw everything anew.
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
      `${line.port}${line.speed ? ` · ${line.speed} baud` : ""} · ${line.drives.length} drives`,
    ),
    frame.lost ? make("p", { class: "bad" }, glyph("port"), ` The port is lost: ${frame.lost}`) : null,
    figures(frame),
    misses(told?.minutes ?? []),
    delays(line, told?.drives ?? {}),
  );
}

function figures({ used = null, planned = null, rate = null, p99 = null, misses: missed = null }) {
  const isOver = used !== null && planned !== null && used > planned + 0.05;
  const bar = make("span", {
    class: "use",
    role: "img",
    "aria-label": `${share(used)} used of ${share(planned)} planned`,
  });
  const [part, mark] = [make("i"), make("u")];
  part.style.width = `${Math.min(1, used ?? 0) * 100}%`;
  mark.style.left = `${Math.min(1, planned ?? 0) * 100}%`;
  mark.hidden = planned === null;
  bar.append(part, mark);
  const pairs = [
    ["Wire used", [share(used), bar]],
    [
      "Planned",
      [share(planned), isOver ? make("small", { class: "warn" }, " more is used than planned") : null],
    ],
    ["Exchanges", [rate === null ? UNKNOWN : `${rate.toFixed(1)} /s`]],
    ["Delay, 99 % within", [milliseconds(p99)]],
    [
      "Missed in the last minute",
      [make("span", { class: missed > 0 ? "warn" : "" }, missed === null ? UNKNOWN : String(missed))],
    ],
  ];
  return make(
    "dl",
    { class: "keys" },
    pairs.map(([title, value]) => make("div", {}, make("dt", {}, title), make("dd", {}, value))),
  );
}

// Draw one bar for each minute, stacked by reason, and the hour's sums as a table.
function misses(minutes) {
  const sums = new Map();
  let asked = 0;
  for (const minute of minutes) {
    asked += minute.asked ?? 0;
    for (const [reason, n] of Object.entries(minute.misses)) sums.set(reason, (sums.get(reason) ?? 0) + n);
  }
  const reasons = [...sums.keys()].sort((a, b) => sums.get(b) - sums.get(a)),
    total = [...sums.values()].reduce((a, b) => a + b, 0);
  if (!minutes.length) return make("p", { class: "note" }, "No misses counted yet.");
  const head = make("h3", {}, `Missed in the last hour: ${total} of ${asked}`);
  if (!total) return make("section", {}, head);
  const most = Math.max(...minutes.map(m => Object.values(m.misses).reduce((a, b) => a + b, 0)));
  return make(
    "section",
    {},
    head,
    make(
      "div",
      { class: "minutes", role: "img", "aria-label": `Missed each minute, at most ${most}` },
      minutes.map(minute => column(minute, reasons, most)),
    ),
    make(
      "div",
      { class: "ends" },
      make("span", {}, `${clock.minute(minutes[0].time)} ${clock.zoneName()}`),
      make("span", {}, `at most ${most} a minute`),
      make("span", {}, clock.minute(minutes[minutes.length - 1].time)),
    ),
    make(
      "table",
      { class: "plain" },
      make(
        "thead",
        {},
        make(
          "tr",
          {},
          ["Reason", "Missed", "Share"].map(h => make("th", { scope: "col" }, h)),
        ),
      ),
      make(
        "tbody",
        {},
        reasons.map((reason, i) =>
          make(
            "tr",
            {},
            make("th", { scope: "row" }, swatch(i), reason),
            make("td", {}, String(sums.get(reason))),
            make("td", {}, share(asked ? sums.get(reason) / asked : null)),
          ),
        ),
      ),
    ),
  );
}

function column(minute, reasons, most) {
  const parts = reasons.map((reason, i) => {
    const part = make("i");
    part.style.height = `${((minute.misses[reason] ?? 0) / most) * 100}%`;
    part.style.background = colour(REASONS[i % REASONS.length]);
    return part;
  });
  const words =
    reasons
      .filter(r => minute.misses[r])
      .map(r => `${r} ${minute.misses[r]}`)
      .join(", ") || "none";
  return make("div", { title: `${clock.minute(minute.time)}: ${words}` }, parts);
}

function swatch(i) {
  const mark = make("i", { class: "swatch", "aria-hidden": "true" });
  mark.style.background = colour(REASONS[i % REASONS.length]);
  return mark;
}

function delays(line, told) {
  const most = Math.max(1, ...Object.values(told).map(d => d.p99 ?? 0));
  return make(
    "section",
    {},
    make("h3", {}, "Response delay of each drive"),
    make(
      "div",
      { class: "scroll" },
      make(
        "table",
        { class: "plain delays" },
        make(
          "thead",
          {},
          make(
            "tr",
            {},
            ["Drive", "Half within", "99 % within", "", "Missed"].map((h, i) =>
              i === 3 ? make("td", {}) : make("th", { scope: "col" }, h),
            ),
          ),
        ),
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
                d.asked ? `${d.missed} of ${d.asked}, ${share(d.missed / d.asked)}` : UNKNOWN,
              ),
            );
          }),
        ),
      ),
    ),
  );
}
