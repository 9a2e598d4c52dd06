// All registers of the chosen drive, polled ones first and command registers last. Each has its value, unit,
// place in the manual, and a button to write it if that is allowed.

import { key, known, mayWrite, store } from "../../data/store.js";
import { said, t } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { make, put, tableHead } from "../../ui/dom.js";
import { UNKNOWN, makeValue, registerName, showValue, withUnit } from "../../ui/values.js";
import { change } from "./actions.js";

let name = null,
  rows = [];

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
    { "aria-label": t("Registers") },
    make("h3", {}, t("Registers")),
    make(
      "table",
      { class: "registers" },
      tableHead([t("Register"), t("Value"), t("Age")]),
      make("tbody", {}, rows.map(row)),
    ),
  );
}

function row({ register, value, age }) {
  return make(
    "tr",
    {},
    make("th", { scope: "row" }, registerName(register), make("small", {}, about(register))),
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
              "aria-label": t("Change {register}", { register: registerName(register) }),
              onclick: () => change(name, register),
            },
            t("Change"),
          )
        : null,
    ),
    age,
  );
}

// Return true if the register has a button to write it. Settings and the setpoint have one; verbs such as
// start write the other registers.
const isOffered = ({ name: register, access }) =>
  (access === "setting" || register === key(name, "setpoint")) && mayWrite(name, register);

// Return a text with the register's place in the manual, its range, and how often it is polled.
function about({ place, access, least, most, step, period_s: period, ...register }) {
  const isLimited = typeof least === "number" && typeof most === "number";
  return [
    place,
    access === "reading" ? null : said(access),
    isLimited ? range(withUnit(t("{low} to {high}", { low: least, high: most }), register), step) : null,
    period ? t("every {age}", { age: clock.lasting(period * 1000) }) : null,
  ]
    .filter(Boolean)
    .join(" · ");
}

const range = (ends, step) => (step ? t("{range} by {step}", { range: ends, step }) : ends);

export function draw(at) {
  for (const { register, value, age } of rows) {
    const found = known(name, register.name, at);
    showValue(value, found, store.drives.get(name).registers.get(register.name), false);
    put(
      age,
      found === null || found.value === null
        ? found
          ? said(found.status)
          : t("not read")
        : clock.lasting(found.age),
    );
    if (age.textContent === "") put(age, UNKNOWN);
  }
}
