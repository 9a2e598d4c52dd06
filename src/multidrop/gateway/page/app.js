// Show the page's views, handle keyboard shortcuts, and redraw: texts and plots five times a second,
// sparklines once a second.

import { get } from "./data/api.js";
import { run } from "./data/link.js";
import { onPlant, store, takePlant } from "./data/store.js";
import * as settings from "./head/settings.js";
import { drawTop, showPlant } from "./head/top.js";
import { stopKey, stopOne } from "./stop.js";
import { plantPath, t } from "./texts.js";
import * as clock from "./ui/clock.js";
import { askToken } from "./ui/dialog.js";
import { find } from "./ui/dom.js";
import * as drive from "./views/drives/drive.js";
import * as plots from "./views/drives/plots.js";
import * as table from "./views/drives/table.js";
import * as faults from "./views/faults.js";
import * as fleet from "./views/fleet.js";
import * as lines from "./views/lines.js";
import * as log from "./views/log.js";
import * as markers from "./views/trends/markers.js";
import * as trends from "./views/trends/trends.js";

const VIEWS = ["drives", "trends", "faults", "lines", "log", "fleet"];
const BEAT_MS = 100;
const WIDE = 1000; // px: minimum width for the panel beside the table

let view = "drives",
  chosen = null,
  beat = 0;

// Show the view that the address names, such as "#/drives/pump-1" or "#/trends?drive=pump-1".
function route() {
  const [path, options] = location.hash.replace(/^#\/?/, "").split("?");
  const [name, rest] = path.split("/");
  const before = view;
  view = VIEWS.includes(name) ? name : "drives";
  for (const other of VIEWS) {
    find(`#${other}`).hidden = other !== view;
    const link = find(`nav a[href="#/${other}"]`);
    if (other === view) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (before === "trends" && view !== "trends") trends.hide();
  if (view === "drives") showDrive(rest ? decoded(rest) : null, Boolean(rest));
  if (view === "trends") trends.show(new URLSearchParams(options ?? ""));
  if (view === "faults") faults.show();
  if (view === "lines") lines.show();
  if (view === "log") log.show();
  if (view === "fleet") fleet.show();
}

function decoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

function showDrive(name, isOpen) {
  const wasOpen = find("#panel").classList.contains("open");
  chosen = name ?? (innerWidth > WIDE ? (chosen ?? store.drives.keys().next().value ?? null) : null);
  table.choose(chosen);
  drive.show(chosen, isOpen);
  if (isOpen && innerWidth <= WIDE) find("#panel h2")?.focus();
  else if (wasOpen && !isOpen) table.focusChosen();
}

// Call a function that draws one part of the page. If it fails, the other parts are drawn nevertheless.
function safely(what) {
  try {
    what();
  } catch (error) {
    console.error(error);
  }
}

function tick() {
  beat++;
  if (beat % 2 === 0) {
    safely(drawTop);
    if (view === "drives") {
      safely(table.drawRows);
      safely(drive.draw);
    }
  }
  if (view === "drives" && beat % 2 === 0) safely(drive.drawPlots);
  if (view === "drives" && beat % 10 === 0) safely(table.drawSparks);
  if (view === "faults" && beat % 10 === 0) safely(faults.show);
  if (view === "lines" && beat % 30 === 0) lines.show();
  if (view === "fleet" && beat % 10 === 0) safely(fleet.show);
  if (view === "drives" && beat % 20 === 0) drive.refresh();
}

// Make the plots again after a change of the window's size, the colours or the time zone.
function redraw() {
  if (view === "drives" && store.drives.has(chosen))
    safely(() => plots.begin(store.drives.get(chosen).spec));
  if (view === "trends") safely(trends.draw);
  if (view === "lines") lines.show();
  safely(log.redraw);
  safely(table.fit);
  safely(drawTop);
}

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || find("#ask").open) return;
  if (event.target.matches("input, select, textarea")) {
    if (event.key === "Escape") event.target.blur();
    return;
  }
  if (view === "trends") {
    if (event.key === "a" || event.key === "b") markers.place(event.key.toUpperCase());
    if (event.key === "Escape") trends.back();
  }
  if (view === "drives") driveKeys(event);
  if (event.key === "u") clock.switchZone();
  const wanted = VIEWS[event.key - 1];
  if (wanted && !find(`nav a[href="#/${wanted}"]`).hidden) location.hash = `#/${wanted}`;
}

function driveKeys(event) {
  const inPanel = event.target.closest("#panel");
  if ((event.key === "ArrowDown" || event.key === "ArrowUp") && !inPanel) {
    const link = table.neighbour(event.key === "ArrowDown" ? 1 : -1);
    link?.focus();
    if (link && innerWidth > WIDE) (history.replaceState(null, "", link.hash), route(), link.focus());
    event.preventDefault();
  } else if (event.key === "/") {
    find("#filter").focus();
    event.preventDefault();
  } else if (stopKey(event) === "one" && chosen !== null) stopOne(chosen);
  else if (event.key === "Escape" && find("#panel").classList.contains("open")) location.hash = "#/drives";
}

let resized = null;
addEventListener("resize", () => {
  clearTimeout(resized);
  resized = setTimeout(redraw, 150);
});
addEventListener("hashchange", route);
addEventListener("keydown", keys);
addEventListener("theme", redraw);
addEventListener("timezone", redraw);
addEventListener(
  "stranger",
  () => find("#ask").open || askToken(t("This gateway shows its values only with a token.")),
);
addEventListener("written", () => drive.refresh());
for (const changed of ["signed", "reloaded"])
  addEventListener(changed, () => get(plantPath).then(takePlant, () => {}));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
find(".skip").addEventListener("click", event => {
  event.preventDefault();
  find("#main").focus();
});

settings.begin();
table.begin();
drive.begin();
trends.begin();
faults.begin();
log.begin();
fleet.begin();
onPlant(showPlant);
onPlant(() => {
  if (view === "drives") route();
});
route();
document.body.dataset.begun = "yes";
setInterval(tick, BEAT_MS);
run();
