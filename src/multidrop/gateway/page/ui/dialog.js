// The page's only dialog: it asks for confirmation or for a token, and shows results.

import { post } from "../data/api.js";
import { t } from "../texts.js";
import { find, fill, make } from "./dom.js";

let answer = null, // function that resolves the open question's promise
  stopAsked = null; // promise of the answer, if the open question is about a stop

const dialog = () => find("#ask");

// A click to ignore: if the dialog opens or closes during a double click, the second click would press a
// button that the user has not seen. It is ignored, unless it asks for a stop. TWICE_MS and NEAR_PX say when
// two clicks are a double click. Also ignored are clicks, Enter and Space from before the change was drawn,
// for example on a slow page, and repetitions of held keys.
const TWICE_MS = 500,
  NEAR_PX = 30,
  AT_ONCE = "#stopall, .stop";
export const DANGER = "danger",
  STOP = "danger stop"; // CSS classes of a button that stops
const STOP_PATIENCE_MS = 45000; // longer than the 30 s for which a stop is repeated to a silent drive
let drawn = -Infinity, // time at which the latest opening or closing of the dialog was drawn
  changes = 0, // how often the dialog opened or closed
  last = { x: 0, y: 0, time: -Infinity, changes }; // the latest click that was not ignored

function changed() {
  const change = ++changes;
  drawn = Infinity;
  requestAnimationFrame(() =>
    requestAnimationFrame(time => {
      if (change === changes) drawn = time;
    }),
  );
}

function isOfBefore({ clientX: x, clientY: y, timeStamp: time, detail }) {
  const isNear = Math.hypot(x - last.x, y - last.y) < NEAR_PX;
  if (changes === last.changes) return false;
  return time < drawn || (isNear && (detail > 1 || time - Math.max(last.time, drawn) < TWICE_MS));
}

// Return true if a click on this element is never ignored: a button for a stop, or the area outside the open
// dialog, in which only "Stop all" works.
const isAtOnce = target => target === dialog() || target.closest?.(AT_ONCE);

addEventListener(
  "click",
  event => {
    const { clientX: x, clientY: y, timeStamp: time, detail } = event;
    if (detail === 0) return; // a key caused this click
    if (isOfBefore(event) && !isAtOnce(event.target)) {
      event.preventDefault();
      event.stopImmediatePropagation();
    } else last = { x, y, time, changes };
  },
  true,
);
addEventListener(
  "keydown",
  event => {
    last.x = -Infinity; // a click after a key is not the second click of a double click
    if (event.repeat && isPress(event)) event.preventDefault();
  },
  true,
);
const isPress = ({ key }) => key === "Enter" || key === " ";
for (const kind of ["keydown", "keyup"])
  addEventListener(
    kind,
    event => {
      if (isPress(event) && event.timeStamp < drawn && !isAtOnce(event.target)) event.preventDefault();
    },
    true,
  );

// Show the dialog and return the user's choice, as `show` does. The question about a stop opens immediately.
// Other dialogs wait until that question is answered.
async function open(title, contents, buttons, { cancel = t("Cancel"), kind } = {}) {
  if (kind === STOP) return (stopAsked = show(title, contents, buttons, cancel));
  while (stopAsked) await stopAsked;
  return show(title, contents, buttons, cancel);
}

// Show the dialog and return the user's choice: a button's name, or null if cancelled. `buttons` are [name,
// text, class]. "Cancel" is the first button and has the focus, so that the Enter key alone sends no command.
function show(title, contents, buttons, cancel) {
  answer?.(null);
  const close = choice => {
    changed();
    answer?.(choice);
    answer = stopAsked = null;
    if (dialog().open) dialog().close();
  };
  const first = make("button", { type: "button", class: "calm", onclick: () => close(null) }, cancel);
  const others = buttons.map(([name, text, kind]) =>
    make(
      "button",
      {
        type: name === "submit" ? "submit" : "button",
        class: kind,
        onclick: event => {
          if (name === "submit" && !find("form", dialog()).reportValidity()) return;
          event.preventDefault();
          close(name);
        },
      },
      text,
    ),
  );
  const form = make(
    "form",
    { onsubmit: event => event.preventDefault() },
    make("h2", { id: "ask-title", tabindex: "-1" }, title),
    contents,
    make(
      "menu",
      {},
      [first, ...others].map(b => make("li", {}, b)),
    ),
  );
  fill(dialog(), form);
  dialog().oncancel = event => {
    event.preventDefault();
    close(null);
  };
  changed();
  if (dialog().open) dialog().close(); // reopened, so that screen readers read it out
  dialog().showModal();
  (find("[data-first]", form) ?? first).focus();
  return new Promise(done => {
    answer = done;
  });
}

// Ask for confirmation. Return true if the user confirms.
export const confirm = async (title, contents, yes, kind = DANGER) =>
  (await open(title, contents, [["yes", yes, kind]], { kind })) === "yes";

// Show a form with these contents. Return true if the user submits it.
export const confirmForm = async (title, contents, yes, kind = DANGER) =>
  (await open(title, contents, [["submit", yes, kind]], { kind })) === "submit";

// Show a message until the user closes it. Return the name of the button if one of `buttons` was pressed.
export const tell = (title, contents, buttons = []) =>
  open(title, contents, buttons, { cancel: t("Close") });

// Ask for a token until the gateway accepts one. Return false if the user cancels.
export async function askToken(why, yes = t("Sign in"), kind = DANGER) {
  let wrong = null;
  for (;;) {
    const field = make("input", {
      type: "password",
      id: "token",
      required: true,
      autocomplete: "current-password",
      "data-first": true,
      "aria-describedby": wrong ? "token-wrong" : null,
    });
    const contents = [
      make("p", {}, why),
      make("label", { for: "token", class: "field" }, t("Token"), field),
      wrong && make("p", { id: "token-wrong", class: "bad" }, wrong),
    ];
    if (!(await confirmForm(t("Sign in"), contents, yes, kind))) return false;
    try {
      await post("api/token", { token: field.value, ...(kind === STOP ? { to: "stop" } : {}) });
      dispatchEvent(new Event("signed"));
      return true;
    } catch (error) {
      wrong = error.message;
    }
  }
}

const IDLE = { sent: () => {}, answered: () => {} };
const patienceOf = kind => (kind === STOP ? STOP_PATIENCE_MS : undefined);

// Send a confirmed command and return the answer. If the user lacks the right to send it, let the user sign
// in and confirm again, and repeat the request. `body` makes the request's body at each confirmation, and
// `kind` is the CSS class of the confirming button. `watch` has the functions `sent` and `answered`, which
// are called before and after each request. Throws Refused.
export async function send(path, body, { kind = DANGER, patience = patienceOf(kind), watch = IDLE } = {}) {
  dispatchEvent(new Event("command"));
  const sent = async () => {
    watch.sent();
    try {
      return await post(path, body(), patience, watch.answered);
    } finally {
      watch.answered();
    }
  };
  try {
    return await sent();
  } catch (error) {
    if (error.status !== 401 && error.status !== 403) throw error;
    const reason = error.message.replace(/[.。]$/, "");
    const why = t("The gateway refused this: {reason}. Enter a token with that right.", { reason });
    if (!(await askToken(why, t("Sign in and send"), kind))) throw error;
    return await sent();
  }
}
