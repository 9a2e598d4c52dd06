// Writes and verbs of one drive: each confirmed by name, sent once, and told of as the gateway says.

import { Refused } from "./api.js";
import { DANGER, STOP, confirm, confirmForm, send } from "./ask.js";
import * as clock from "./clock.js";
import { fill, find, glyph, make, named, say } from "./dom.js";
import { now } from "./link.js";
import { watchStop } from "./stop.js";
import { mayAct, reading, stops, store } from "./store.js";
import { text, unit, withUnit, words } from "./values.js";

const MOST = 20; // outcomes that are kept on the page; the log has all
const outcomes = [];
const WITH_HZ = new Set(["set_frequency"]);
const STOPS = new Set(["coast", "emergency_stop"]); // are sent whatever came before
const TURNS = ["start", "jog", "run", "forward", "reverse"];

// Make the verbs that the page's user may give, and the place where outcomes stand.
export function build(spec) {
  const verbs = (spec.verbs ?? []).filter(verb => verb !== "stop" && mayAct(spec.name, verb));
  const box = make(
    "section",
    { class: "actions", "aria-label": "Commands" },
    verbs.length
      ? make(
          "div",
          { class: "verbs" },
          verbs.map(verb =>
            make("button", { type: "button", onclick: () => act(spec.name, verb) }, words(verb)),
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

// Return what makes the body at its confirmation, with the frame that was seen then; to be called as it is
// asked for. What comes behind the dialog is seen by nobody: after a stop of the drive, or with another
// plant, whose drives may have each other's names, it fails.
function seen(drive) {
  const stopped = stops(drive),
    { revision } = store.plant;
  return body => () => {
    if (stops(drive) !== stopped) throw new Refused(409, "A stop of it was called meanwhile.");
    if (store.frame?.revision !== revision) throw new Refused(409, "The plant was read anew meanwhile.");
    return { ...body, seen: store.frame.n };
  };
}

async function deliver(drive, what, path, confirmed, kind = DANGER) {
  try {
    const watch = kind === STOP ? { watch: watchStop(drive) } : {};
    const { done, text: told } = await send(path, confirmed, { kind, ...watch });
    note(drive, what, done === true, told);
  } catch (error) {
    const isRefused = error.status >= 400 && error.status < 500;
    note(
      drive,
      what,
      false,
      isRefused
        ? `not sent. ${error.message}`
        : `${error.message} It is not known whether it was carried out.`,
    );
  }
}

// Ask, and give a verb: with a frequency where it takes one.
export async function act(drive, verb) {
  const turns = TURNS.some(word => verb.includes(word)),
    field = WITH_HZ.has(verb) ? hertz() : null,
    withSeen = seen(drive),
    isStop = STOPS.has(verb),
    kind = isStop ? STOP : DANGER;
  const warning = turns
    ? "The motor will turn. Make sure that nobody is near what it drives."
    : "It is sent once.";
  const contents = [make("p", { class: turns ? "bad" : "" }, warning)];
  if (field) contents.push(make("label", { class: "field", for: field.id }, "Frequency, Hz", field));
  const asks = field ? confirmForm : confirm;
  const title = [`${words(verb)}: `, named(drive), "?"],
    yes = [`${words(verb)} `, named(drive)];
  if (!(await asks(title, contents, yes, kind))) return;
  const options = field ? { hz: Number(field.value) } : {};
  const what = field ? `${words(verb)} ${options.hz} Hz` : words(verb);
  const body = { drive, verb, options };
  await deliver(drive, what, "api/act", isStop ? () => body : withSeen(body), kind);
}

const hertz = () =>
  make("input", {
    id: "new-value",
    type: "number",
    min: 0,
    step: "any",
    required: true,
    "data-first": true,
  });

// Ask for a value, and write it.
export async function change(drive, register) {
  const current = reading(drive, register.name, now()),
    name = words(register.name),
    withSeen = seen(drive);
  const field = editor(register);
  const held =
    current?.value === null || !current ? null : withUnit(text(current.value, register), register);
  const past = current?.isOld ? `not known now; ${clock.lasting(current.age)} ago it was ` : "";
  const is = held === null ? "Its value is not known." : `It is ${past}${held}.`;
  const limits = isLimited(register)
    ? ` From ${register.least} to ${withUnit(register.most, register)}.`
    : "";
  const contents = [
    make("p", {}, is + limits),
    make(
      "label",
      { class: "field", for: "new-value" },
      `New value${unit(register) ? `, ${unit(register)}` : ""}`,
      field,
    ),
  ];
  if (
    !(await confirmForm([`Change ${name} of `, named(drive), "?"], contents, ["Write to ", named(drive)]))
  )
    return;
  const value = Number(field.value);
  if (field.value === "" || !Number.isFinite(value)) return;
  const what = `${name} = ${text(value, register)} ${unit(register)}`.trim();
  await deliver(drive, what, "api/write", withSeen({ drive, register: register.name, value }));
}

const isLimited = ({ least, most }) => typeof least === "number" && typeof most === "number";

// It begins empty: Enter alone sends nothing, least of all a value that is no longer true.
function editor(register) {
  const common = { id: "new-value", required: true, "data-first": true };
  if (register.kind === "words" && register.words) {
    return make(
      "select",
      common,
      make("option", { value: "" }, "choose"),
      Object.entries(register.words).map(([value, word]) =>
        make("option", { value }, `${word} (${value})`),
      ),
    );
  }
  return make("input", {
    ...common,
    type: "number",
    inputmode: "decimal",
    autocomplete: "off",
    step: register.step ?? "any",
    min: register.least ?? null,
    max: register.most ?? null,
  });
}
