// Stops of one drive and of all drives. This file needs only the dialog and no other part of the page, so
// that stops work even if the rest fails.

import { pieces, said, t } from "./texts.js";
import { STOP, confirm, send, tell } from "./ui/dialog.js";
import { fill, find, glyph, make, named } from "./ui/dom.js";

const HOW = t(
  "A stop is sent before all polling and repeated until the drive confirms it. " +
    "Each motor slows down as set in its drive.",
);
const SENT = t("Sending the stop.");
const TAKEN = t(
  "The gateway has accepted the stop. If a drive does not answer, its stop is repeated for 30 s; the " +
    "outcome is shown then.",
);
const UNTAKEN = t("The gateway has not accepted the stop");
const HARD = t("Use the hard-wired stop at the machine if a motor must stop now.");
const HARD_NOW = t("Use the hard-wired stop at the machine now. This page keeps waiting for the gateway.");
const TAKEN_MS = 1500; // time limit for the gateway to confirm that it has accepted a stop

// Return the target of the button "Stop all" in the present view: the button's label, the target's name, the
// requests.
function target() {
  const { drives, lines, plant, fleet } = find("#stopall").dataset;
  const all = drives > 1 ? t("all {n} drives", { n: drives }) : t("all drives");
  const where = lines > 1 ? t("All {n} lines at once.", { n: lines }) : "";
  const own = ["api/stop", { drives: null }];
  if (!fleet || !location.hash.startsWith("#/fleet"))
    return { label: t("Stop all"), what: all, where, requests: [own] };
  const here = t("{drives} of {plant}", { drives: all, plant });
  if (fleet === "stops")
    return {
      label: t("Stop the fleet"),
      what: t("the whole fleet"),
      where: t("All drives of all lines of the fleet, and {here}.", { here }),
      requests: [own, ["api/fleet/stop", {}]],
    };
  return {
    label: t("Stop this plant"),
    what: here,
    where: t(
      "This stops the drives of this plant only. To stop the fleet, run `multidrop fleet stop --all`.",
    ),
    requests: [own],
  };
}

// Label the button "Stop all" with its target.
export function showTarget() {
  const { label, what } = target();
  find("#stopall").textContent = label;
  find("#stopall").title = t("Stop {what}", { what });
}

async function stopAll() {
  const { what, where, requests } = target();
  const contents = [make("p", {}, where ? `${where} ${HOW}` : HOW)];
  if (await confirm(t("Stop {what}?", { what }), contents, t("Stop {what}", { what }), STOP))
    await stop(requests, what);
}

export async function stopOne(name) {
  const title = pieces("Stop {what}?", { what: named(name) }),
    yes = pieces("Stop {what}", { what: named(name) });
  if (await confirm(title, [make("p", {}, HOW)], yes, STOP))
    await stop([["api/stop", { drives: [name] }]], name);
}

// Show a stop's progress in a dialog, and return callbacks for the stop's requests. A working gateway
// confirms within half a second that it has accepted a stop.
function showProgress(what, isShown) {
  const title = make("span"),
    words = make("p", { role: "alert" });
  const show = (head, text, isBad) => {
    fill(title, ...head);
    fill(words, isBad ? glyph("fault") : null, ` ${text}`);
    words.className = isBad ? "bad" : "";
  };
  const open = () => void tell(title, [words]).catch(() => {});
  const stopping = pieces("Stopping {what} …", { what: named(what) });
  show(stopping, `${SENT} ${HARD}`, false);
  if (isShown) open();
  const waiting = new Set(); // timers of requests that the gateway has not confirmed yet
  const late = () => {
    const unconfirmed = t("No confirmation within {n} s.", { n: TAKEN_MS / 1000 });
    show([UNTAKEN], `${unconfirmed} ${HARD_NOW}`, true);
    if (!words.closest("dialog[open]")) open();
  };
  return () => {
    let timer = null;
    return {
      sent: () => waiting.add((timer = setTimeout(late, TAKEN_MS))),
      answered: () => {
        clearTimeout(timer);
        if (waiting.delete(timer) && !waiting.size) show(stopping, `${TAKEN} ${HARD}`, false);
      },
    };
  };
}

// Return callbacks for a request whose verb stops a drive. They open a dialog only if the gateway does not
// confirm that it has accepted the request.
export const watchStop = name => showProgress(name, false)();

async function stop(requests, what) {
  let again = "again";
  while (again === "again") {
    const watch = showProgress(what, true);
    const ends = await Promise.all(requests.map(([path, body]) => ending(path, body, watch())));
    const failed = ends.find(end => end.error);
    const shown = failed
      ? failure(failed.error, ends)
      : outcome(Object.assign({}, ...ends.map(e => e.told)));
    again = await tell(
      shown.title,
      shown.contents,
      shown.isWhole ? [] : [["again", t("Send the stop again"), STOP]],
    );
  }
}

async function ending(path, body, watch) {
  try {
    return { told: await send(path, () => body, { kind: STOP, watch }) };
  } catch (error) {
    return { error };
  }
}

// Return the title and the contents of the dialog after a failed request of a stop: the failure, and the
// results of the other requests.
function failure(error, ends) {
  const isRefused = error.status >= 400 && error.status < 500;
  const others = ends.filter(end => end.told).map(end => outcome(end.told));
  return {
    title: isRefused ? t("The stop was not sent") : t("It is unknown whether the stop was sent"),
    contents: [
      make("p", { class: "bad" }, glyph("fault"), ` ${error.message} ${HARD}`),
      ...others.flatMap(({ title, contents }) => [make("p", {}, `${title}.`), ...contents]),
    ],
  };
}

// Return the title and the contents of a dialog with the gateway's answer to a stop, and true if all drives
// have stopped.
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
      `: ${said(text)}`,
    ),
  );
  const isWhole = rows.length > 0 && failed.length === 0;
  const title = isWhole
    ? rows.length === 1
      ? t("The drive is stopped")
      : t("All {n} drives are stopped", { n: rows.length })
    : rows.length
      ? t("{n} of {all} drives are not confirmed as stopped", { n: failed.length, all: rows.length })
      : t("No drive was stopped");
  const contents = [
    items.length ? make("ul", { class: "outcome" }, items) : null,
    isWhole ? null : make("p", {}, HARD),
  ];
  return { title, contents: contents.filter(Boolean), isWhole };
}

const WHOLE_MS = 8000; // time limit for loading the page's other files

// Show a message if the page's other files were not loaded in time.
setTimeout(() => {
  if (document.body.dataset.begun) return;
  find("#notice").textContent = t(
    "This page was not fully loaded. Stop all works; reload the page for the rest.",
  );
  find("#notice").classList.add("bad");
  find("#notice").hidden = false;
}, WHOLE_MS);

find("#stopall").addEventListener("click", stopAll);
addEventListener("hashchange", showTarget);
// "Stop all" also works while a dialog is open. Its question then replaces that dialog.
find("#ask").addEventListener("click", event => {
  const isIn = element => {
    const { left, right, top, bottom } = element.getBoundingClientRect();
    return (
      left <= event.clientX && event.clientX <= right && top <= event.clientY && event.clientY <= bottom
    );
  };
  const ask = find("#ask");
  if (event.target === ask && !isIn(ask) && isIn(find("#stopall"))) stopAll();
});
find("#stopall").disabled = false;
find("#notice").hidden = true;
find("#notice").classList.remove("loading", "bad");

// Return which stop a key asks for: "one" for S, "all" for Shift+S, else null. On a keyboard layout without
// the letter S, the key at the same place counts. With caps lock on, S means "all" with and without Shift.
export function stopKey({ key, code, shiftKey }) {
  const isStop = /^[a-z]$/i.test(key) ? key.toLowerCase() === "s" : code === "KeyS";
  return !isStop ? null : shiftKey || key === "S" ? "all" : "one";
}

addEventListener("keydown", event => {
  // The key S works like the button, except in text fields.
  const isTyped = event.target.closest?.("input, select, textarea");
  const isOther = event.ctrlKey || event.metaKey || event.altKey || event.repeat;
  if (stopKey(event) === "all" && !isOther && !isTyped) stopAll();
});
