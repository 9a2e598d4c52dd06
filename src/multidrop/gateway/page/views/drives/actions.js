// Writes and verbs of one drive: the user confirms the drive's name, and the page sends the command once and
// shows the gateway's answer.

import { Refused } from "../../data/api.js";
import { now } from "../../data/link.js";
import { key, known, mayAct, stops, store } from "../../data/store.js";
import { watchStop } from "../../stop.js";
import { pieces, said, t } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { DANGER, STOP, confirm, confirmForm, send } from "../../ui/dialog.js";
import { fill, find, glyph, make, named, say } from "../../ui/dom.js";
import { registerName, text, unit, unitName, withUnit, words } from "../../ui/values.js";

const MOST = 20; // limit of results that the page lists; the audit log has all
const outcomes = [];
const WITH_HZ = new Set(["set_frequency"]);
const STOPS = new Set(["coast", "emergency_stop"]); // verbs that are sent even after a stop or a reload
const TURNS = ["start", "jog", "run", "forward", "reverse"];

// Make the buttons of the verbs that the page's user may send, and the list of results.
export function build(spec) {
  const verbs = (spec.verbs ?? []).filter(verb => verb !== "stop" && mayAct(spec.name, verb));
  const box = make(
    "section",
    { class: "actions", "aria-label": t("Commands") },
    verbs.length
      ? make(
          "div",
          { class: "verbs" },
          verbs.map(verb =>
            make("button", { type: "button", onclick: () => act(spec.name, verb) }, said(words(verb))),
          ),
        )
      : null,
    make("ul", { class: "outcome", id: "outcomes" }),
  );
  show(spec.name, box);
  return box;
}

function show(drive, at = document) {
  const list = find("#outcomes", at);
  if (list) {
    fill(
      list,
      outcomes
        .filter(o => o.drive === drive)
        .map(o =>
          make(
            "li",
            { class: o.done ? "" : "bad" },
            make("time", {}, `${clock.time(o.time)} `),
            o.done ? null : glyph("fault"),
            `${o.what}: ${o.text}`,
          ),
        ),
    );
  }
}

function note(drive, what, done, told) {
  outcomes.unshift({ time: now(), drive, what, done, text: told });
  outcomes.splice(MOST);
  say(`${what}: ${told}`);
  show(drive);
  dispatchEvent(new Event("written"));
}

// Return a function that makes the request's body when the user confirms. Call this when the dialog opens,
// because the body contains the number of the newest frame that the user has seen. The returned function
// throws if the drive was stopped or the plant was reloaded since the dialog opened. After a reload, names
// may mean other drives.
function seen(drive) {
  const stopped = stops(drive),
    { revision } = store.plant;
  return body => () => {
    if (stops(drive) !== stopped) throw new Refused(409, t("The drive was stopped in the meantime."));
    if (store.frame?.revision !== revision)
      throw new Refused(409, t("The plant file was reloaded in the meantime."));
    return { ...body, seen: store.frame.n };
  };
}

async function deliver(drive, what, path, confirmed, kind = DANGER) {
  try {
    const watch = kind === STOP ? { watch: watchStop(drive) } : {};
    const { done, text: told } = await send(path, confirmed, { kind, ...watch });
    note(drive, what, done === true, said(told));
  } catch (error) {
    const isRefused = error.status >= 400 && error.status < 500;
    note(
      drive,
      what,
      false,
      isRefused
        ? t("not sent. {why}", { why: error.message })
        : t("{why} The outcome is unknown.", { why: error.message }),
    );
  }
}

// Ask for confirmation, and for a frequency if the verb takes one, and send the verb.
async function act(drive, verb) {
  const turns = TURNS.some(word => verb.includes(word)),
    asked = WITH_HZ.has(verb) ? hertz(drive) : null,
    withSeen = seen(drive),
    isStop = STOPS.has(verb),
    kind = isStop ? STOP : DANGER;
  const warning = turns
    ? t("The motor will turn. Make sure that nobody is near the machine.")
    : t("The command is sent once.");
  const contents = [make("p", { class: turns ? "bad" : "" }, warning), ...(asked?.contents ?? [])];
  const asks = asked ? confirmForm : confirm;
  const verbName = said(words(verb)),
    title = [`${verbName}: `, named(drive), "?"],
    yes = [`${verbName} `, named(drive)];
  if (!(await asks(title, contents, yes, kind))) return;
  const options = asked ? { hz: Number(asked.field.value) } : {};
  const what = asked ? `${verbName} ${options.hz} ${said("Hz")}` : verbName;
  const body = { drive, verb, options };
  await deliver(drive, what, "api/act", isStop ? () => body : withSeen(body), kind);
}

// Return an input field for a frequency in Hz, with its texts. If the setpoint register has another unit, the
// present setpoint is shown in that unit, and the input is limited only by the register of the maximum
// frequency.
function hertz(drive) {
  const { registers } = store.drives.get(drive);
  const setpoint = registers.get(key(drive, "setpoint"));
  const isHertz = setpoint && unit(setpoint) === "Hz";
  const maximum = registers.get("maximum_frequency");
  const [least, most] = isHertz ? limits(drive, setpoint) : [0, maximum ? held(drive, maximum.name) : null];
  const field = make("input", { ...FIELD, type: "number", min: least ?? 0, max: most, step: "any" });
  return {
    field,
    contents: [
      make("p", {}, setpoint ? `${present(drive, setpoint)} ${span([least ?? 0, most], said("Hz"))}` : ""),
      make("label", { class: "field", for: field.id }, t("Frequency, Hz"), field),
    ],
  };
}

// Return a register's newest value, or null if it is old or unknown.
function held(drive, register) {
  const found = known(drive, register, now());
  return found && !found.isOld ? found.value : null;
}

// Return the least and the largest value that may be written to a register. These are the register's own
// limits, or the values of other registers that limit it, whichever are stricter.
function limits(drive, { least, most, at_least: atLeast, at_most: atMost }) {
  const ends = [
    [least, held(drive, atLeast)],
    [most, held(drive, atMost)],
  ].map(pair => pair.filter(end => typeof end === "number"));
  return [Math.max(...ends[0]), Math.min(...ends[1])].map(end => (Number.isFinite(end) ? end : null));
}

// Return a sentence with a register's present value.
function present(drive, register) {
  const current = known(drive, register.name, now()),
    name = registerName(register);
  if (!current || current.value === null)
    return t("The value of {register} is unknown.", { register: name });
  const shown = withUnit(text(current.value, register), register);
  return current.isOld
    ? t("{register} is unknown now; {age} ago it was {value}.", {
        register: name,
        age: clock.lasting(current.age),
        value: shown,
      })
    : t("{register} is {value}.", { register: name, value: shown });
}

// Return a sentence about the values that may be written.
function span([least, most], of) {
  const [from, to] = [least, most].map(end => end !== null && `${end} ${of}`.trim());
  if (least !== null && most !== null) return t("Allowed: from {from} to {to}.", { from: least, to });
  if (least !== null) return t("Allowed: from {from}.", { from });
  return most !== null ? t("Allowed: to {to}.", { to }) : t("No limits known.");
}

export async function change(drive, register) {
  const name = registerName(register),
    withSeen = seen(drive),
    ends = limits(drive, register);
  const field = editor(register, ends);
  const isNumber = register.kind === "number";
  const contents = [
    make("p", {}, `${present(drive, register)}${isNumber ? ` ${span(ends, unitName(register))}` : ""}`),
    make(
      "label",
      { class: "field", for: "new-value" },
      [t("New value"), unitName(register)].filter(Boolean).join(", "),
      field,
    ),
  ];
  const title = pieces("Change {register} of {drive}?", { register: name, drive: named(drive) }),
    yes = pieces("Write to {drive}", { drive: named(drive) });
  if (!(await confirmForm(title, contents, yes))) return;
  const value = Number(field.value);
  if (field.value === "" || !Number.isFinite(value)) return;
  const what = `${name} = ${withUnit(text(value, register), register)}`;
  await deliver(drive, what, "api/write", withSeen({ drive, register: register.name, value }));
}

const FIELD = { id: "new-value", required: true, "data-first": true };

// Return the input field for a value. It is empty at first, so that the Enter key alone sends no value.
function editor(register, [least, most]) {
  if (register.kind === "words" && register.words) {
    return make(
      "select",
      FIELD,
      make("option", { value: "" }, t("choose")),
      Object.entries(register.words).map(([value, word]) =>
        make("option", { value }, `${said(word)} (${value})`),
      ),
    );
  }
  return make("input", {
    ...FIELD,
    type: "number",
    inputmode: "decimal",
    autocomplete: "off",
    step: register.step ?? "any",
    min: least,
    max: most,
  });
}
