// Details of the chosen drive that frames do not contain: response delays, failed reads by reason, EEPROM
// budgets, writes.

import { get } from "../../data/api.js";
import { takeOthers } from "../../data/store.js";
import { said, t } from "../../texts.js";
import { fill, find, make, tableHead } from "../../ui/dom.js";
import { UNKNOWN, milliseconds, share, words } from "../../ui/values.js";
import { auditRows } from "../log.js";

let name = null;

export function build(spec) {
  name = spec.name;
  refresh();
  return make(
    "div",
    {},
    make("section", { id: "delays", "aria-label": t("Delays and misses") }),
    make("section", { id: "writes", "aria-label": t("Writes") }),
  );
}

// Fetch the details and show them. If a request fails, its error is shown in place of its data.
export async function refresh() {
  const asked = name;
  const [told, log] = await Promise.allSettled([
    get(`api/drive/${encodeURIComponent(asked)}`),
    get("api/audit?count=200"),
  ]);
  if (asked !== name || !find("#delays")) return;
  if (told.status === "fulfilled") takeOthers(asked, told.value.values);
  fill(
    find("#delays"),
    make("h3", {}, t("Delays and misses")),
    told.status === "fulfilled" ? delays(told.value) : make("p", { class: "note" }, told.reason.message),
  );
  fill(
    find("#writes"),
    make("h3", {}, t("Writes to this drive")),
    log.status === "fulfilled"
      ? writes(log.value, asked)
      : make("p", { class: "note" }, log.reason.message),
  );
}

function delays({ delays, misses, asked, ledger }) {
  const total = Object.values(misses ?? {}).reduce((sum, n) => sum + n, 0);
  return [
    make(
      "p",
      { class: "note" },
      t("Response delay: 50 % within {half}, 99 % within {most}.", {
        half: milliseconds(delays?.p50),
        most: milliseconds(delays?.p99),
      }),
    ),
    delays?.counts?.length ? histogram(delays.counts) : null,
    make(
      "p",
      { class: "note" },
      asked
        ? t("Missed {n} of {all} values, {share}.", { n: total, all: asked, share: share(total / asked) })
        : t("No values requested yet."),
    ),
    total
      ? make(
          "table",
          { class: "plain" },
          tableHead([t("Reason"), t("Missed")]),
          make(
            "tbody",
            {},
            Object.entries(misses).map(([reason, n]) =>
              make("tr", {}, make("th", { scope: "row" }, said(reason)), make("td", {}, String(n))),
            ),
          ),
        )
      : null,
    ledger?.length
      ? make(
          "p",
          { class: "note" },
          t("EEPROM writes in the last year: {writes}", { writes: ledger.map(yearly).join(", ") }),
        )
      : null,
  ].filter(Boolean);
}

const yearly = ({ register, year, budget }) =>
  t("{register} {n} of {all}", {
    register: words(register),
    n: year,
    all: budget ?? UNKNOWN,
  });

// Draw a histogram of response delays: for each range of delays a bar, the range, and the number of replies.
function histogram(counts) {
  const most = Math.max(...counts.map(([, n]) => n)),
    last = counts[counts.length - 1][0];
  const bars = counts.map(([from, n], i) => {
    const [low, high] = [from, counts[i + 1]?.[0]].map(milliseconds),
      range = i + 1 < counts.length ? t("{low} to {high}", { low, high }) : t("{low} and more", { low });
    const bar = make("i", { title: `${range}: ${n}` });
    bar.style.height = `${most ? Math.max(n ? 4 : 0, (n / most) * 100) : 0}%`;
    return bar;
  });
  return make(
    "div",
    {
      class: "histogram",
      role: "img",
      "aria-label": t("Replies by response delay, {low} to {high}", {
        low: milliseconds(counts[0][0]),
        high: milliseconds(last),
      }),
    },
    make("div", { class: "bars" }, bars),
    make(
      "div",
      { class: "ends" },
      make("span", {}, milliseconds(counts[0][0])),
      make("span", {}, milliseconds(last)),
    ),
  );
}

function writes({ entries }, drive) {
  const own = (entries ?? []).filter(entry => entry.drive === drive);
  return own.length
    ? auditRows(own, false, 20)
    : make("p", { class: "note" }, t("None among the newest 200 writes."));
}
