// Misses of a line in the last hour, by minute and by reason.

import { said, t } from "../texts.js";
import * as clock from "../ui/clock.js";
import { colour, make, tableHead } from "../ui/dom.js";
import { share } from "../ui/values.js";

const HOUR = 60; // minutes
const REASONS = ["c2", "c4", "c1", "c3", "c5", "c6"];

// Draw a bar for each minute, stacked by reason, and a table of the hour's sums.
export function misses(minutes) {
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
      .map(r => `${said(r)} ${minute.misses[r]}`)
      .join(", ") || t("none");
  return make("div", { title: `${clock.minute(minute.time)}: ${words}` }, parts);
}

function swatch(i) {
  const mark = make("i", { class: "swatch", "aria-hidden": "true" });
  mark.style.background = colour(REASONS[i % REASONS.length]);
  return mark;
}
