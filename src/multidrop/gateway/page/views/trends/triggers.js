// The choice of a trigger in the trends. A trigger is a condition in the plant file; the trends show the time
// around the last moment at which it became true.

import { get } from "../../data/api.js";
import { now } from "../../data/link.js";
import { sentence, t } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { fill, make } from "../../ui/dom.js";
import * as markers from "./markers.js";
import * as picker from "./picker.js";

const LOOK_MS = 5000;
const LATE_MS = 5000; // values may reach the history this long after their time

let last = [], // the gateway's last triggers, newest first
  chosen = null, // the trigger that is shown
  isShown = false,
  timer = null,
  setRange = () => {},
  fetchAgain = () => {};
const choice = make("select", { id: "trigger", hidden: true, "aria-label": t("Last trigger"), onchange });

// Return the element for the choice. `set` is called with the time range around the chosen trigger, and `ask`
// repeatedly while values of that range arrive.
export function begin(set, ask) {
  [setRange, fetchAgain] = [set, ask];
  return choice;
}

// Look for new triggers periodically while the trends are shown.
export function watch(is) {
  isShown = is;
  clearTimeout(timer);
  if (is) look();
}

// Forget the shown trigger, because the user has chosen another time range.
export function leave() {
  chosen = null;
  choice.value = "";
}

// Return a sentence about the trigger that is shown, or "".
export function note() {
  if (!chosen) return "";
  const time = clock.milli(Date.parse(chosen.time));
  return sentence(t("Trigger {name} at {time}: {condition}", { ...chosen, time }));
}

async function look() {
  try {
    last = (await get("api/triggers")).triggers;
    draw();
    const newest = last.find(({ name }) => name === chosen?.name);
    if (newest && newest.time !== chosen.time) around(newest);
    else if (newest && isArriving(newest)) fetchAgain();
  } catch {
    // not reported here: the head of the page says that the gateway does not answer
  }
  clearTimeout(timer);
  if (isShown) timer = setTimeout(look, LOOK_MS);
}

// Return true if newer values around a trigger may have arrived since the values were fetched.
const isArriving = one => now() < Date.parse(one.to) + LATE_MS + LOOK_MS;

function draw() {
  choice.hidden = !last.length;
  fill(
    choice,
    make("option", { value: "" }, t("Last trigger")),
    last.map(({ name, time }) =>
      make("option", { value: name }, `${name}, ${clock.milli(Date.parse(time))}`),
    ),
  );
  choice.value = chosen?.name ?? "";
}

function onchange() {
  const one = last.find(({ name }) => name === choice.value);
  if (one) around(one);
  else leave();
}

// Show the time range around a trigger, and put the third marker at its moment.
function around(one) {
  markers.setTrigger(Date.parse(one.time));
  picker.chooseSignals(one.signals);
  setRange(Date.parse(one.from), Date.parse(one.to), false);
  fetchAgain(); // also if the range is the previous one
  chosen = one;
  choice.value = one.name;
}
