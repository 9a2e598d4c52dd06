// Stops: of all drives and of one. This file needs the dialog and nothing else of the page.

import { STOP, confirm, retell, send, tell } from "./ask.js";
import { find, glyph, make, named } from "./dom.js";

const PATIENCE_MS = 20000;
let asked = null; // the question whether to stop that was asked last: no outcome takes its place
const HOW =
  "A stop goes ahead of all polling and is repeated until the drive confirms it. " +
  "Motors come down as their drives are set.";
const HARD = "Use the hard stop at the machine if a motor must stand now.";

// Ask, and stop all drives.
export async function stopAll() {
  const { drives, lines } = find("#stopall").dataset;
  const all = drives ? `all ${drives} drives` : "all drives";
  const where = lines > 1 ? `All ${lines} lines at once. ` : "";
  asked = confirm(`Stop ${all}?`, [make("p", {}, where + HOW)], `Stop ${all}`, STOP);
  if (await asked) await stop(null, "all drives");
}

// Ask, and stop this drive.
export async function stopOne(name) {
  asked = confirm(["Stop ", named(name), "?"], [make("p", {}, HOW)], ["Stop ", named(name)], STOP);
  if (await asked) await stop([name], name);
}

async function stop(drives, what) {
  let again = "again";
  while (again === "again") {
    const closed = tell(["Stopping ", named(what), " …"], [make("p", {}, "The stop is on its way.")]);
    closed.catch(() => {});
    let shown;
    try {
      const told = await send("api/stop", () => ({ drives }), { kind: STOP, patience: PATIENCE_MS });
      shown = outcome(told);
    } catch (error) {
      const isRefused = error.status >= 400 && error.status < 500;
      const title = isRefused ? "The stop was not sent" : "It is not known that the stop was sent";
      shown = {
        title,
        contents: [make("p", { class: "bad" }, glyph("fault"), ` ${error.message} ${HARD}`)],
      };
    }
    await asked;
    again = await retell(
      shown.title,
      shown.contents,
      shown.isWhole ? [] : [["again", "Send the stop again", STOP]],
    );
  }
}

// Return a title, what to show and whether every drive stands, of the gateway's answer.
function outcome(told) {
  const rows = Object.entries(told),
    failed = rows.filter(([, { done }]) => done !== true);
  const list = rows.length <= 1 ? rows : failed;
  const items = list.map(([name, { done, text }]) =>
    make(
      "li",
      { class: done === true ? "" : "bad" },
      done === true ? null : glyph("fault"),
      named(name),
      `: ${text}`,
    ),
  );
  const isWhole = rows.length > 0 && failed.length === 0;
  const title = isWhole
    ? rows.length === 1
      ? "The drive is stopped"
      : `All ${rows.length} drives are stopped`
    : rows.length
      ? `${failed.length} of ${rows.length} drives not known to be stopped`
      : "No drive was stopped";
  const contents = [
    items.length ? make("ul", { class: "outcome" }, items) : null,
    isWhole ? null : make("p", {}, HARD),
  ];
  return { title, contents: contents.filter(Boolean), isWhole };
}

const WHOLE_MS = 8000; // in which the other parts of the page should be there

// Say so where the other parts of the page could not be loaded: nothing else would.
setTimeout(() => {
  if (document.body.dataset.begun) return;
  find("#notice").textContent =
    "This page could not be loaded whole. Stop all works; load it again for the rest.";
  find("#notice").classList.add("bad");
  find("#notice").hidden = false;
}, WHOLE_MS);

find("#stopall").addEventListener("click", stopAll);
// Stop all lies behind an open dialog, and is at hand all the same: in place of what else is asked.
find("#ask").addEventListener("click", event => {
  const isIn = element => {
    const { left, right, top, bottom } = element.getBoundingClientRect();
    return left <= event.clientX && event.clientX <= right && top <= event.clientY && event.clientY <= bottom;
  };
  const ask = find("#ask");
  if (event.target === ask && !isIn(ask) && isIn(find("#stopall"))) stopAll();
});
find("#stopall").disabled = false;
find("#notice").hidden = true;
find("#notice").classList.remove("loading", "bad");
addEventListener("keydown", event => {
  // The focus is still in the dialog for some milliseconds after that was closed.
  const isElsewhere = find("#ask").open || event.target.closest?.("input, select, textarea");
  if (event.key === "S" && !event.ctrlKey && !event.metaKey && !event.altKey && !isElsewhere) stopAll();
});
