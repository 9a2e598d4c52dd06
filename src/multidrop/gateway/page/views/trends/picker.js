// The choice of the drives and registers that the trends show.

import { key, state, store } from "../../data/store.js";
import { t } from "../../texts.js";
import { fill, find, make, named } from "../../ui/dom.js";
import { COLOURS, DASHES, swatch } from "../../ui/plots.js";
import { title } from "../../ui/values.js";

const MOST_DRIVES = COLOURS.length * DASHES.length;
const MOST_SIGNALS = 4; // limit of the registers of a trigger, so that their plots fit on a screen
const NOTE = t(
  "The band shows the smallest and largest value at each point, the line the mean. A gap has no values. " +
    "Drag to zoom in.",
);

let chosen = [],
  registers = [],
  faults = true,
  query = "",
  changed = () => {},
  place = null;

export function begin(into, what) {
  [place, changed] = [into, what];
}

let wanted = null; // drive named by the page's address before the plant was known

// Deselect the drives and registers that the present plant lacks. If none are left, select a default.
export function takePlant() {
  chosen = chosen.filter(name => store.drives.has(name));
  if (wanted !== null) choose(wanted);
  wanted = null;
  const all = [...store.drives.keys()];
  if (!chosen.length) chosen = [...all.filter(name => state(name) === "runs"), ...all].slice(0, 1);
  if (!quantities().length)
    registers = [...new Set(chosen.flatMap(name => [key(name, "frequency"), key(name, "current")]))];
  if (!quantities().length)
    registers = numbers()
      .map(({ name }) => name)
      .slice(0, 1);
  draw();
}

// Select only this drive.
export function choose(name) {
  if (!store.plant) wanted = name;
  if (!store.drives.has(name)) return;
  chosen = [name];
  registers = [...new Set([...registers, key(name, "frequency"), key(name, "current")])];
  draw();
}

// Select the drives of the signals, and the registers whose values are numbers, at most MOST_SIGNALS
// registers.
export function chooseSignals(signals) {
  chosen = [...new Set(signals.map(({ drive }) => drive))].filter(name => store.drives.has(name));
  const there = numbers().map(({ name }) => name);
  registers = [...new Set(signals.map(({ register }) => register))]
    .filter(name => there.includes(name))
    .slice(0, MOST_SIGNALS);
  takePlant();
}

export const drives = () => chosen;
// Return the selected registers that a selected drive polls. The others are not shown, so the user could not
// deselect them.
export const quantities = () => {
  const there = numbers().map(({ name }) => name);
  return registers.filter(name => there.includes(name));
};
export const isPolled = (name, register) => {
  const period = store.drives.get(name).registers.get(register)?.period_s;
  return period !== undefined && period !== null;
};
export const showsFaults = () => faults;
export const index = name => chosen.indexOf(name);

function numbers() {
  const found = new Map();
  for (const name of chosen)
    for (const r of store.drives.get(name).spec.registers)
      if (r.kind === "number" && r.period_s !== null) found.set(r.name, r);
  return [...found.values()];
}

export function draw() {
  const isOpen = find("details", place)?.open ?? innerWidth > 1000;
  const filter = make("input", {
    type: "search",
    placeholder: t("Find a drive"),
    "aria-label": t("Find a drive"),
    autocomplete: "off",
    oninput: event => {
      query = event.target.value.toLowerCase();
      show();
    },
  });
  filter.value = query;
  const names = [...store.drives.keys()];
  const list = make(
    "div",
    { class: "choices", role: "group", "aria-label": t("Drives") },
    names.map(choice),
  );
  const show = () => {
    for (const label of list.children) label.hidden = !label.textContent.toLowerCase().includes(query);
  };
  fill(
    place,
    make(
      "details",
      { open: isOpen },
      make("summary", {}, t("Drives and quantities")),
      make("h2", {}, t("Drives")),
      names.length > 8 ? filter : null,
      list,
      make("h2", {}, t("Quantities")),
      make(
        "div",
        { class: "choices", role: "group", "aria-label": t("Quantities") },
        numbers().map(r =>
          check(title(r), registers.includes(r.name), is => {
            registers = toggled(registers, r.name, is);
            changed();
          }),
        ),
        check(t("faults and silence"), faults, is => {
          faults = is;
          changed();
        }),
      ),
      make("p", { class: "note" }, NOTE),
    ),
  );
  show();
}

const toggled = (list, name, is) => (is ? [...list, name] : list.filter(other => other !== name));

function choice(name) {
  const at = chosen.indexOf(name);
  return check(
    named(name),
    at >= 0,
    is => {
      if (!is || chosen.length < MOST_DRIVES) chosen = toggled(chosen, name, is);
      draw();
      find(`input[data-name="${CSS.escape(name)}"]`, place)?.focus();
      changed();
    },
    name,
    at,
  );
}

function check(label, is, what, name = null, at = -1) {
  const box = make("input", {
    type: "checkbox",
    "data-name": name,
    onchange: event => what(event.target.checked),
  });
  box.checked = is;
  return make("label", {}, box, at >= 0 ? swatch(at) : null, make("span", {}, label));
}
