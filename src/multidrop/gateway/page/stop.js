// Stops: of all drives and of one. This file needs the dialog and nothing else of the page.

import { STOP, confirm, send, tell } from "./ask.js";
import { find, glyph, make, named } from "./dom.js";

const HOW =
  "A stop goes ahead of all polling and is repeated until the drive confirms it. " +
  "Motors come down as their drives are set.";
const WAITING =
  "The stop is on its way. Where a drive does not answer it is repeated for 30 s, and told of after that.";
const HARD = "Use the hard stop at the machine if a motor must stand now.";

// Ask, and stop all drives.
export async function stopAll() {
  const { drives, lines } = find("#stopall").dataset;
  const all = drives > 1 ? `all ${drives} drives` : "all drives";
  const where = lines > 1 ? `All ${lines} lines at once. ` : "";
  const isSure = await confirm(`Stop ${all}?`, [make("p", {}, where + HOW)], `Stop ${all}`, STOP);
  if (isSure) await stop(null, "all drives");
}

// Ask, and stop this drive.
export async function stopOne(name) {
  const [title, yes] = [["Stop ", named(name), "?"], ["Stop ", named(name)]];
  if (await confirm(title, [make("p", {}, HOW)], yes, STOP)) await stop([name], name);
}

async function stop(drives, what) {
  let again = "again";
  while (again === "again") {
    const closed = tell(["Stopping ", named(what), " …"], [make("p", {}, `${WAITING} ${HARD}`)]);
    closed.catch(() => {});
    let shown;
    try {
      const told = await send("api/stop", () => ({ drives }), { kind: STOP });
      shown = outcome(told);
    } catch (error) {
      const isRefused = error.status >= 400 && error.status < 500;
      const title = isRefused ? "The stop was not sent" : "It is not known that the stop was sent";
      shown = {
        title,
        contents: [make("p", { class: "bad" }, glyph("fault"), ` ${error.message} ${HARD}`)],
      };
    }
    again = await tell(
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

// Return "one" or "all" for the keys that ask for a stop, S and Shift S, else null. Where a layout has no
// such letter it is that key; with caps lock on, S is "all" with Shift or without.
export function stopKey({ key, code, shiftKey }) {
  const isStop = /^[a-z]$/i.test(key) ? key.toLowerCase() === "s" : code === "KeyS";
  return !isStop ? null : shiftKey || key === "S" ? "all" : "one";
}

addEventListener("keydown", event => {
  // Where nothing is typed the key is at hand like the button, behind a dialog too.
  const isTyped = event.target.closest?.("input, select, textarea");
  const isOther = event.ctrlKey || event.metaKey || event.altKey || event.repeat;
  if (stopKey(event) === "all" && !isOther && !isTyped) stopAll();
});
