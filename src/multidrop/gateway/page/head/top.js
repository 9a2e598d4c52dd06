// The head of the page: plant, views, the newest frame's age, clock, the user's rights, and the strip with
// alarms.

import { correction, link, now } from "../data/link.js";
import { LIVE_MS, isLive, lasting, state, store } from "../data/store.js";
import { showTarget } from "../stop.js";
import { said, sentence, t } from "../texts.js";
import * as clock from "../ui/clock.js";
import { fill, find, glyph, make, named, put, say, setClass } from "../ui/dom.js";
import { drives } from "../ui/values.js";

const DEAD_MS = 3000;
const SKEW_MS = 2000; // larger errors of the viewer's clock are reported
const RIGHTS = { look: t("may look"), stop: t("may stop"), write: t("may write") };
let told = "";
let shownStrip = "",
  ages = []; // [element, alarm] for each duration in the strip

export function showPlant() {
  const { plant } = store;
  const name = plant.name.replace(/\.toml$/, "");
  put(find("#plant"), name);
  document.title = `${name} – multidrop`;
  const stopall = find("#stopall");
  stopall.dataset.drives = store.drives.size;
  stopall.dataset.lines = store.lines.size;
  stopall.dataset.plant = name;
  stopall.dataset.fleet = plant.fleet ? (plant.fleet_stop ? "stops" : "looks") : "";
  showTarget();
  const right = RIGHTS[plant.may?.role ?? "look"];
  put(find("#role"), plant.demo ? t("simulated, {right}", { right }) : right);
}

// Update the head of the page. Called a few times a second.
export function drawTop() {
  const at = now(),
    age = at - store.time,
    isNow = isLive(at);
  const words =
    store.frame === null
      ? store.isLost
        ? t("no connection")
        : t("connecting")
      : isNow
        ? t("live")
        : t("{age} old", { age: t("{n} s", { n: Math.max(1, Math.round(age / 1000)) }) });
  put(
    find("#link span"),
    age < 120000 || store.frame === null ? words : t("{age} old", { age: clock.lasting(age) }),
  );
  setClass(find("#link"), "stale", !isNow);
  setClass(document.body, "stale", store.frame !== null && !isNow);
  setClass(document.body, "dead", store.frame !== null && (store.isLost || age > DEAD_MS));
  put(find("#clock"), `${clock.time(at)} ${clock.zoneName()}`);
  drawNotice(isNow, age);
  tellChange(isNow);
  drawStrip(at);
}

function drawNotice(isNow, age) {
  const parts = [];
  if (store.isLost) parts.push(sentence(link.why));
  else if (store.frame && age > LIVE_MS) parts.push(t("The gateway sends no new values."));
  if (store.frame && !isNow)
    parts.push(
      t("The values shown are from {time}.", { time: `${clock.when(store.time)} ${clock.zoneName()}` }),
    );
  const wrong = store.plant?.mistakes?.length ?? 0;
  if (wrong === 1) parts.push(t("The plant file has a mistake; the previous plant stays in use."));
  if (wrong > 1)
    parts.push(t("The plant file has {n} mistakes; the previous plant stays in use.", { n: wrong }));
  for (const trouble of store.frame?.troubles ?? []) parts.push(`${said(trouble)}.`);
  const off = correction();
  if (Math.abs(off) > SKEW_MS) {
    const time = clock.lasting(Math.abs(off));
    parts.push(
      off > 0
        ? t("This device's clock is {time} slow; times shown here are the gateway's.", { time })
        : t("This device's clock is {time} fast; times shown here are the gateway's.", { time }),
    );
  }
  const notice = find("#notice");
  put(notice, parts.join(" "));
  notice.hidden = parts.length === 0;
  setClass(notice, "bad", !isNow);
}

function tellChange(isNow) {
  const words = store.frame === null && !store.isLost ? "" : isNow ? "live" : "old";
  if (words && words !== told && (told || words === "old"))
    say(words === "live" ? t("Values are live again.") : t("Values are old: no new values arrive."));
  told = words || told;
}

// Show the active alarms with their full texts; a click opens the alarm's drive.
function drawStrip(at) {
  const alarms = lasting(),
    most = innerWidth < 641 ? 2 : 5;
  const number = find("#count"),
    open = alarms.filter(alarm => !alarm.acknowledged);
  put(number, String(open.length || ""));
  number.hidden = open.length === 0;
  const shown = alarms.slice(0, most);
  setClass(
    find("#strip"),
    "bad",
    open.some(alarm => alarm.kind === "fault"),
  );
  const sign = JSON.stringify([shown, alarms.length, calm()]);
  if (sign !== shownStrip) buildStrip(shown, alarms.length - shown.length);
  shownStrip = sign;
  for (const [age, alarm] of ages) put(age, `, ${clock.since(alarm, at)}`);
}

// Return the text of the strip without alarms.
function calm() {
  if (!store.frame) return t("No values yet.");
  const unknown = [...store.drives.keys()].filter(name => state(name) === "unknown").length;
  const all = drives(store.drives.size);
  return unknown
    ? t("{drives}, no known fault, none silent, {n} in unknown state.", { drives: all, n: unknown })
    : t("{drives}, no known fault, none silent.", { drives: all });
}

function buildStrip(alarms, more) {
  const strip = find("#strip");
  ages = [];
  if (!alarms.length) fill(strip, make("li", {}, calm()));
  else
    fill(
      strip,
      alarms.map(item),
      more ? make("li", {}, make("a", { href: "#/faults" }, t("and {n} more", { n: more }))) : null,
    );
}

function item(alarm) {
  const { kind, drive, line, text, acknowledged } = alarm;
  const age = make("span", { class: "since" });
  ages.push([age, alarm]);
  const href = drive ? `#/drives/${encodeURIComponent(drive)}` : "#/lines";
  return make(
    "li",
    {},
    make(
      "a",
      { class: acknowledged ? "seen" : kind, href },
      glyph(kind),
      named(drive || t("line {line}", { line })),
      ": ",
      named(said(text)),
      age,
    ),
  );
}
