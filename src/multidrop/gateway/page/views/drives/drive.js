// The view of one drive: state, plots, registers, response delays, and results of writes.

import { now } from "../../data/link.js";
import { driveAge, isLive, known, noteOf, onPlant, state, store } from "../../data/store.js";
import { stopOne } from "../../stop.js";
import { pieces, said, t } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { fill, find, glyph, make, named, put } from "../../ui/dom.js";
import { STATES, makeValue, showValue } from "../../ui/values.js";
import * as actions from "./actions.js";
import * as details from "./details.js";
import * as parameters from "./parameters.js";
import * as plots from "./plots.js";
import * as registers from "./registers.js";

const KEYS = [
  ["frequency", t("Frequency")],
  ["setpoint", t("Setpoint")],
  ["current", t("Current")],
];
const TITLES = { motor_speed: t("Motor speed") }; // label of a register shown in place of the frequency

let chosen = null,
  parts = null;

export const panel = () => find("#panel");

export function begin() {
  onPlant(() => show(chosen, false));
}

// Show this drive, or a message if no drive has this name. If `isOpen`, the drive's panel covers a small
// screen.
export function show(name, isOpen) {
  chosen = name;
  const drive = store.drives.get(name);
  panel().classList.toggle("open", isOpen && name !== null);
  plots.clear();
  parts = null;
  if (!drive) {
    fill(
      panel(),
      make(
        "p",
        { class: "empty" },
        name === null || !store.plant
          ? t("Select a drive to see its plots and registers.")
          : pieces("There is no drive {drive} in this plant.", { drive: named(name) }),
      ),
    );
    return;
  }
  build(drive);
  draw();
  drawPlots();
}

function build({ spec, line }) {
  parts = { shape: make("span"), word: make("span"), age: make("span"), note: make("p"), keys: [] };
  parts.note.className = "note";
  parts.says = make("span", {}, parts.shape, " ", parts.word);
  const where = pieces("{model} · address {address} on {line} · {speed}", {
    model: spec.family,
    address: String(spec.address),
    line: named(line.name),
    speed: spec.speed,
  });
  const keys = KEYS.filter(([part]) => spec.key?.[part]).map(([part, title]) => {
    const value = makeValue();
    parts.keys.push([spec.key[part], value]);
    const told = TITLES[spec.key[part]] ?? title;
    return make("div", {}, make("dt", {}, told), make("dd", {}, value.whole));
  });
  fill(
    panel(),
    make(
      "div",
      { class: "panelhead" },
      make("h2", { tabindex: "-1" }, named(spec.name)),
      make("p", {}, where),
      make("p", { class: "stateline" }, parts.says, parts.age),
      parts.note,
      make(
        "div",
        { class: "acts" },
        make(
          "button",
          {
            type: "button",
            class: "danger stop",
            onclick: () => stopOne(spec.name),
            "aria-label": t("Stop {what}", { what: spec.name }),
          },
          t("Stop"),
        ),
        make("a", { class: "button close", href: "#/drives", "aria-label": t("Close") }, "✕"),
      ),
    ),
    keys.length ? make("dl", { class: "keys" }, keys) : null,
    actions.build(spec),
    plots.build(spec),
    registers.build(spec),
    details.build(spec),
    parameters.build(spec),
  );
  plots.begin(spec);
}

// Update the texts of the view. Called a few times a second.
export function draw() {
  if (!parts) return;
  const at = now(),
    drive = store.drives.get(chosen),
    is = state(chosen),
    age = driveAge(chosen, at);
  for (const [register, value] of parts.keys)
    showValue(value, known(chosen, register, at), drive.registers.get(register));
  if (parts.state !== is) fill(parts.shape, glyph(STATES[is] ? is : "unknown"));
  parts.state = is;
  const words_ =
    is === "fault"
      ? t("fault: {what}", { what: said(store.frame.drives[chosen].fault ?? "unknown") })
      : (STATES[is] ?? is);
  put(parts.word, isLive(at) || !store.frame ? words_ : t("last: {word}", { word: words_ }));
  parts.says.className = `stateword ${is}`;
  put(
    parts.age,
    age === null ? t("never answered") : t("last reply {age} ago", { age: clock.lasting(age) }),
  );
  put(parts.note, said(noteOf(chosen)));
  parts.note.hidden = !noteOf(chosen);
  registers.draw(at);
}

export const drawPlots = () => parts && plots.draw();

// Fetch the details that frames do not contain.
export const refresh = () => parts && details.refresh();
