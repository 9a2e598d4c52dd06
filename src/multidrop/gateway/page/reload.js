// The plant file, read again: asked for first, and told of with every mistake that is in it.

import { confirm, send, tell } from "./ask.js";
import { glyph, make, named } from "./dom.js";
import { store } from "./store.js";

const PATIENCE_MS = 60000; // a plan of many lines is long work
const WHAT =
  "What is polled becomes what the file says now. No motor is started or stopped; the drives that leave go " +
  "on as they are. Where anything in the file is wrong, the plant goes on as before.";

// Return whether this page's user may have the file read again.
export const mayReload = () => store.plant?.file === true && store.plant.may?.role === "write";

// Ask, and have the plant file read again.
export async function reload() {
  const file = () => named(store.plant.name);
  if (!(await confirm(["Read ", file(), " again?"], [make("p", {}, WHAT)], ["Read ", file()]))) return;
  tell(["Reading ", file(), " …"], [make("p", {}, "The plant is polled meanwhile.")]);
  let shown;
  try {
    shown = outcome(await send("api/reload", () => ({ confirm: true }), { patience: PATIENCE_MS }));
  } catch (error) {
    const isRefused = error.status >= 400 && error.status < 500;
    const title = isRefused ? "The file was not read" : "It is not known that the file was read";
    shown = [title, make("p", { class: "bad" }, glyph("fault"), ` ${error.message}`)];
  }
  dispatchEvent(new Event("reloaded"));
  await tell(...shown);
}

// Return a title, and what to show of the gateway's answer.
function outcome({ done, text, mistakes = [], restart = [] }) {
  if (done === true) {
    const waits = restart.length
      ? [make("p", {}, "What waits for a restart:"), list(restart, "")]
      : [make("p", {}, "Nothing in it waits for a restart.")];
    return [text, waits];
  }
  const count = mistakes.length === 1 ? "1 mistake" : `${mistakes.length} mistakes`;
  return [
    mistakes.length ? `The file has ${count}` : "The file was not read",
    [make("p", {}, `${text[0].toUpperCase()}${text.slice(1)}.`), list(mistakes, "bad")],
  ];
}

const list = (sentences, kind) =>
  sentences.length
    ? make(
        "ul",
        { class: "outcome", tabindex: "0", "aria-label": "Sentences" }, // keys scroll it
        sentences.map(sentence =>
          make("li", { class: kind }, kind ? glyph("fault") : null, named(sentence)),
        ),
      )
    : make("p");
