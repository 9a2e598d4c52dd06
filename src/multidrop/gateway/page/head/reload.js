// The dialogs for a reload of the plant file: the question, and the list of all mistakes.

import { store } from "../data/store.js";
import { pieces, t } from "../texts.js";
import { confirm, send, tell } from "../ui/dialog.js";
import { glyph, make, named } from "../ui/dom.js";

const PATIENCE_MS = 60000; // request timeout: planning many lines takes long
const WHAT = t(
  "Polling follows the new file. No motor is started or stopped, and motors of removed drives keep their " +
    "state. If the file has a mistake, nothing changes.",
);

export const mayReload = () => store.plant?.file === true && store.plant.may?.role === "write";

export async function reload() {
  const file = () => named(store.plant.name);
  const title = pieces("Reload {file}?", { file: file() }),
    yes = pieces("Reload {file}", { file: file() });
  if (!(await confirm(title, [make("p", {}, WHAT)], yes))) return;
  tell(pieces("Reloading {file} …", { file: file() }), [make("p", {}, t("Polling continues."))]);
  let shown;
  try {
    shown = outcome(await send("api/reload", () => ({ confirm: true }), { patience: PATIENCE_MS }));
  } catch (error) {
    const isRefused = error.status >= 400 && error.status < 500;
    const title = isRefused
      ? t("The file was not reloaded")
      : t("It is unknown whether the file was reloaded");
    shown = [title, make("p", { class: "bad" }, glyph("fault"), ` ${error.message}`)];
  }
  dispatchEvent(new Event("reloaded"));
  await tell(...shown);
}

// Return the title and the contents of the dialog with the gateway's answer.
function outcome({ done, text, mistakes = [], restart = [] }) {
  if (done === true) {
    const waits = restart.length
      ? [make("p", {}, t("Needs a restart:")), list(restart, "")]
      : [make("p", {}, t("No restart is needed."))];
    return [text, waits];
  }
  const n = mistakes.length;
  const count = t(n === 1 ? "The file has {n} mistake" : "The file has {n} mistakes", { n });
  return [
    n ? count : t("The file was not reloaded"),
    [make("p", {}, `${text[0].toUpperCase()}${text.slice(1)}.`), list(mistakes, "bad")],
  ];
}

const list = (sentences, kind) =>
  sentences.length
    ? make(
        "ul",
        { class: "outcome", tabindex: "0", "aria-label": t("Messages") }, // focusable, so that keys scroll it
        sentences.map(sentence =>
          make("li", { class: kind }, kind ? glyph("fault") : null, named(sentence)),
        ),
      )
    : make("p");
