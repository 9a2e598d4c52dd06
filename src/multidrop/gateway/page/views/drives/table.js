// The table of drives by line: its rows, its filter, and the chosen drive.

import { now } from "../../data/link.js";
import { isLive, key, onPlant, state, store } from "../../data/store.js";
import { t } from "../../texts.js";
import { colour, fill, find, make, put, setClass, tableHead } from "../../ui/dom.js";
import { drives } from "../../ui/values.js";
import { drawHead, drawRow, fullBar, makeHead, makeRow } from "./rows.js";
import { spark } from "./spark.js";

const HEADS = [
  [t("Drive"), "name"],
  [t("Model"), "model"],
  [t("State"), "state"],
  [t("Frequency"), "frequency"],
  [t("Current"), "current"],
  [t("Last minute"), "minute"],
  [t("Age"), "age"],
  [t("Missed"), "missed"],
];
const SHOWN = {
  all: [t("All"), () => true],
  runs: [t("Running"), s => s === "runs"],
  stands: [t("Stopped"), s => s === "stands" || s === "still"],
  bad: [t("Fault, silent, unknown"), s => s === "fault" || s === "silent" || s === "unknown"],
};

const scale = make("span", { class: "full" });
const MANY = 60; // in a plant with more drives, a line that is folded shows only its drives with a problem
let rows = [],
  heads = [],
  show = "all",
  query = "",
  chosen = null;
const opened = new Set(), // names of the lines whose drives are all shown
  none = make("p", { class: "note", id: "none", role: "status" });

// Make the table, and the filter for its drives, for the present plant.
export function begin() {
  onPlant(build);
  const filter = find("#filter");
  filter.addEventListener("input", () => {
    query = filter.value.trim().toLowerCase();
    drawFilter();
  });
  fill(
    find("#chips"),
    Object.entries(SHOWN).map(([name, [title]]) =>
      make(
        "button",
        {
          type: "button",
          "data-show": name,
          "aria-pressed": name === show,
          onclick: () => {
            show = name;
            drawFilter();
          },
        },
        `${title} `,
        make("b", {}, ""),
      ),
    ),
  );
}

function build() {
  rows = [];
  heads = [];
  const table = make(
    "table",
    {},
    make("caption", { class: "hidden" }, t("Drives by line")),
    tableHead(HEADS),
    store.plant.lines.map(body),
  );
  find("th.frequency", table).prepend(scale, " ");
  fill(find("#table"), table, none);
  fit();
  choose(chosen);
  drawRows();
  drawFilter();
}

function body(line) {
  const isFoldable = store.plant.lines.length > 1 && store.drives.size > MANY;
  const head = makeHead(line, isFoldable ? () => unfold(line.name) : null);
  head.rows = line.drives.map(makeRow);
  heads.push(head);
  rows.push(...head.rows);
  return make(
    "tbody",
    {},
    head.row,
    head.rows.map(r => r.row),
  );
}

function unfold(line) {
  if (!opened.delete(line)) opened.add(line);
  drawFilter();
}

// Make the rows of lines as wide as all columns that the window has room for.
export function fit() {
  const columns = [...document.querySelectorAll("#table thead th")].filter(
    th => getComputedStyle(th).display !== "none",
  ).length;
  for (const th of document.querySelectorAll("#table tr.head th")) th.colSpan = Math.max(1, columns);
}

// Mark the chosen drive's row, and let the Tab key focus it.
export function choose(name) {
  chosen = name;
  const first = rows.find(r => r.name === name) ?? rows[0];
  for (const r of rows) {
    r.link.tabIndex = r === first ? 0 : -1;
    if (r.name === name) r.link.setAttribute("aria-current", "true");
    else r.link.removeAttribute("aria-current");
    setClass(r.row, "chosen", r.name === name);
  }
  drawFilter();
}

// Return the link of the drive that is `step` rows below the focused drive, or null.
export function neighbour(step) {
  const there = rows.filter(r => !r.row.hidden);
  const focused = there.findIndex(r => r.link === document.activeElement);
  const at = focused >= 0 ? focused : there.findIndex(r => r.name === chosen);
  return there[Math.max(0, Math.min(there.length - 1, at < 0 ? 0 : at + step))]?.link ?? null;
}

export const focusChosen = () => rows.find(r => r.name === chosen)?.link.focus();

export function drawRows() {
  const at = now(),
    full = fullBar(at);
  put(scale, full === null ? "" : t("full bar {n} Hz", { n: full }));
  const changed = rows.map(row => drawRow(row, at, full)).includes(true);
  if (changed) drawFilter();
  for (const h of heads) drawHead(h);
}

export function drawSparks() {
  const run = colour("run"),
    dim = colour("bar"),
    at = now(),
    isNow = isLive(at);
  for (const r of rows) {
    const register = key(r.name, "frequency");
    spark(
      r.canvas,
      store.drives.get(r.name).pasts.get(register),
      isNow ? store.time : at,
      state(r.name) === "runs" && isNow ? run : dim,
    );
  }
}

const isProblem = r => store.frame !== null && SHOWN.bad[1](state(r.name));

function drawFilter() {
  const isFiltered = show !== "all" || query !== "";
  for (const h of heads) {
    const isOpen = !h.fold || isFiltered || opened.has(h.line.name);
    for (const r of h.rows) {
      const text = `${r.text} ${r.word.textContent.toLowerCase()}`;
      const isMatch = SHOWN[show][1](state(r.name)) && text.includes(query);
      r.row.hidden = !isMatch || !(isOpen || isProblem(r) || r.name === chosen);
    }
    h.row.hidden = isFiltered && h.rows.every(r => r.row.hidden);
    h.fold?.setAttribute("aria-expanded", isOpen);
    const running = h.rows.filter(r => state(r.name) === "runs").length;
    put(h.count, t("{drives}, {n} running", { drives: drives(h.rows.length), n: running }));
  }
  put(none, isFiltered && rows.every(r => r.row.hidden) ? t("No drive matches the filter.") : "");
  for (const button of find("#chips").children) {
    const is = SHOWN[button.dataset.show][1];
    button.setAttribute("aria-pressed", button.dataset.show === show);
    put(find("b", button), String(rows.filter(r => is(state(r.name))).length));
  }
}
