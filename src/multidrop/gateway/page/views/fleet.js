// The view of a fleet: its gateways, which gateway polls each line as its master, and the latest changes of
// masters. Old data are shown with their age, missing data as dashes.

import { get } from "../data/api.js";
import { onPlant, store } from "../data/store.js";
import { pieces, said, sentence, t } from "../texts.js";
import * as clock from "../ui/clock.js";
import { fill, find, glyph, make, named, put, setClass, tableHead } from "../ui/dom.js";
import { UNKNOWN } from "../ui/values.js";

const OLD_S = 3;
const MOST_LINES = 200; // limit of lines that are shown; those whose master does not answer come first
const NAMES = new Intl.Collator("en", { numeric: true }); // line-2 before line-10
const UNITS = ["B", "kB", "MB", "GB", "TB"];
const TABLES = {
  gateways: [
    t("Gateways"),
    [
      ...[
        t("Gateway"),
        t("Host"),
        t("State"),
        t("Lines"),
        t("Lease left"),
        t("Spool"),
        t("Unsent"),
        t("Lag"),
      ],
      ...[t("Rows lost"), t("Session"), t("Since")],
    ],
  ],
  lines: [t("Lines"), [t("Line"), t("Port"), t("Master"), t("Since")]],
  moves: [t("Latest changes of master"), [t("Line"), t("Time"), t("From"), t("To")]],
};

let newest = null,
  silent = new Set(), // gateways that do not answer: their lines may be unpolled
  ordered = [], // the fleet's lines
  cameAt = 0, // when the newest data arrived, by this device's clock
  why = "",
  isAsking = false;

export function begin() {
  fill(
    find("#fleet"),
    make("p", { class: "card note", id: "fleet-age" }),
    Object.entries(TABLES).map(([id, [title, heads]]) => card(id, title, heads)),
  );
  onPlant(() => {
    find('nav a[href="#/fleet"]').hidden = !store.plant.fleet;
    if (!store.plant.fleet) [newest, ordered] = [null, []];
  });
}

function card(id, title, heads) {
  return make(
    "article",
    { class: "card", "aria-label": title },
    make("h2", {}, title),
    make("p", { class: "note", id: `fleet-${id}-note` }),
    make(
      "div",
      { class: "scroll", tabindex: "0", role: "group", "aria-label": t("{title}, table", { title }) },
      make("table", { class: "plain" }, tableHead(heads), make("tbody", { id: `fleet-${id}` })),
    ),
  );
}

// Fetch the fleet; until then draw the previous data with their age.
export function show() {
  draw();
  if (!isAsking) ask();
}

async function ask() {
  isAsking = true;
  try {
    [newest, why] = [await get("api/fleet"), ""];
    cameAt = performance.now();
    order(newest.gateways, Object.entries(newest.lines));
  } catch (problem) {
    why = problem.message;
  }
  isAsking = false;
  draw();
}

function order(gateways, lines) {
  silent = new Set(Object.keys(gateways).filter(name => !gateways[name].says));
  const urgency = ([, { master }]) => (master === null ? 0 : silent.has(master) ? 1 : 2);
  ordered = lines.sort((a, b) => urgency(a) - urgency(b) || NAMES.compare(a[0], b[0]));
}

function draw() {
  const age = newest?.age_s == null ? null : newest.age_s + (performance.now() - cameAt) / 1000,
    { gateways = {}, moves = [] } = newest ?? {};
  drawAge(age, age === null || age > OLD_S);
  const members = Object.entries(gateways),
    free = ordered.filter(([, { master }]) => master === null).length,
    unsure = ordered.filter(([, { master }]) => silent.has(master)).length,
    counts = t("{n} lines, {free} without a master", { n: ordered.length, free }),
    others = unsure ? t("{n} with a master that does not answer", { n: unsure }) : "",
    more = ordered.length > MOST_LINES ? t("the first {n} are shown", { n: MOST_LINES }) : "";
  note("gateways", members.flatMap(troubles).join("; "), true);
  const known = [counts, others].filter(Boolean).join(", ");
  note("lines", [known, more].filter(Boolean).join("; "), free + unsure > 0);
  note("moves", t("A dash means that no master was seen."), false);
  drawTable("gateways", members.map(gateway));
  drawTable("lines", ordered.slice(0, MOST_LINES).map(line));
  drawTable("moves", moves.map(move));
}

function note(id, text, isBad) {
  const place = find(`#fleet-${id}-note`);
  put(place, text);
  setClass(place, "bad", isBad);
  place.hidden = !text;
}

function troubles([name, { says }]) {
  const lines = Object.entries(says?.troubles ?? {}).map(
    ([line, why]) => `${name}: ${t("line {line}", { line })}: ${said(why)}`,
  );
  return [
    ...lines,
    ...[says?.trouble, says?.spool?.trouble].filter(Boolean).map(one => `${name}: ${said(one)}`),
  ];
}

function drawAge(age, isOld) {
  const seen =
      age === null
        ? t("The fleet has not been seen yet")
        : t("Seen {age} ago", { age: clock.lasting(age * 1000) }),
    reason = why || newest?.trouble,
    place = find("#fleet-age");
  const status = isOld
    ? [seen, reason && said(reason)].filter(Boolean).join(": ")
    : t("Updated once a second.");
  put(place, `${sentence(status)} ${t("Times are {zone}.", { zone: clock.zoneName() })}`);
  setClass(place, "bad", isOld);
  setClass(find("#fleet"), "stale", isOld);
}

// Draw a table's rows. Each cell also has its column's head, which a narrow screen shows beside the cell.
function drawTable(id, made) {
  const heads = TABLES[id][1];
  fill(
    find(`#fleet-${id}`),
    made.map(([first, ...others]) =>
      make(
        "tr",
        {},
        make("th", { scope: "row" }, first),
        others.map((one, i) => make("td", { "data-head": heads[i + 1] }, one)),
      ),
    ),
  );
}

// Return the table cells of a gateway, with dashes for values that the gateway does not report.
function gateway([name, { host, session, began_ms: began, lines, says }]) {
  const spool = says?.spool;
  return [
    named(name),
    named(host),
    says ? named(said(says.state)) : wrong("silent", t("no answer")),
    String(lines),
    says ? seconds(says.margin_s) : UNKNOWN,
    spool ? bytes(spool.bytes) : UNKNOWN,
    spool?.behind == null ? UNKNOWN : String(spool.behind),
    spool?.lag_s == null ? UNKNOWN : seconds(spool.lag_s),
    spool ? (spool.lost ? wrong("fault", String(spool.lost)) : "0") : UNKNOWN,
    String(session),
    clock.when(began),
  ];
}

const line = ([name, { port, master, since_ms: from }]) => [
  named(name),
  named(port),
  master === null
    ? wrong("port", t("none"))
    : silent.has(master)
      ? make(
          "span",
          { class: "bad" },
          glyph("silent"),
          " ",
          pieces("{master}, no answer", { master: named(master) }),
        )
      : named(master),
  from === null ? UNKNOWN : clock.when(from),
];

const move = ({ line: name, at_ms: at, from, to }) => [
  named(name),
  clock.when(at),
  from === null ? UNKNOWN : named(from || t("nobody")),
  named(to || t("nobody")),
];

const wrong = (shape, text) => make("span", { class: "bad" }, glyph(shape), ` ${text}`);
const seconds = s => t("{n} s", { n: s.toFixed(1) });

function bytes(number) {
  const power = Math.min(UNITS.length - 1, Math.floor(Math.log10(Math.max(1, number)) / 3)),
    value = number / 1000 ** power;
  return `${value.toFixed(power && value < 10 ? 1 : 0)} ${UNITS[power]}`;
}
