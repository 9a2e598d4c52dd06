// All registers of the selected drive, polled registers first and commands last. Each has its value, unit,
// place in the manual, and a button to write it if allowed.

import { change } from "./actions.js";
import * as clock from "./clock.js";
import { make, put, tableHead } from "./dom.js";
import { key, known, mayWrite, store } from "./store.js";
import { UNKNOWN, makeValue, showValue, withUnit, words } from "./values.js";

let name = null,
  rows = [];

// Make the table for a drive.
export function build(spec) {
  name = spec.name;
  const rank = ({ period_s: period, access }) => (period ? 0 : access === "command" ? 2 : 1);
  const sorted = [...spec.registers].sort((a, b) => rank(a) - rank(b));
  rows = sorted.map(register => ({
    register,
    value: makeValue(),
    age: make("td", { class: "age" }),
  }));
  return make(
    "section",
    { "aria-label": "Registers" },
    make("h3", {}, "Registers"),
    make(
      "table",
      { class: "registers" },
      tableHead(["Register", "Value", "Age"]),
      make("tbody", {}, rows.map(row)),
    ),
  );
}

function row({ register, value, age }) {
  return make(
    "tr",
    {},
    make("th", { scope: "row" }, words(register.name), make("small", {}, about(register))),
    make(
      "td",
      {},
      value.whole,
      isOffered(register)
        ? make(
            "button",
            {
              type: "button",
              class: "change",
              "aria-label": `Change ${words(register.name)}`,
              onclick: () => change(name, register),
            },
            "Change",
          )
        : null,
    ),
    age,
  );
}

// Of the command registers only the setpoint can be written; verbs write the others.
const isOffered = ({ name: register, access }) =>
  (access === "setting" || register === key(name, "setpoint")) && mayWrite(name, register);

// Return the register's place in the manual, its range and period.
function about({ place, access, least, most, step, period_s: period, ...register }) {
  const isLimited = typeof least === "number" && typeof most === "number";
  return [
    place,
    access === "reading" ? null : access,
    isLimited ? withUnit(`${least} to ${most}`, register) + (step ? ` by ${step}` : "") : null,
    period ? `every ${clock.lasting(period * 1000)}` : null,
  ]
    .filter(Boolean)
    .join(" · ");
}

export function draw(t) {
  for (const { register, value, age } of rows) {
    const found = known(name, register.name, t);
    showValue(value, found, store.drives.get(name).registers.get(register.name), false);
    put(
      age,
      found === null || found.value === null
        ? (found?.status ?? "not read")
        : clock.lasting(found.age),
    );
    if (age.textContent === "") put(age, UNKNOWN);
  }
}
