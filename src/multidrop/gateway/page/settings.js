// Settings of this browser: time zone, theme, token, and a list of keyboard shortcuts.

import { post } from "./api.js";
import { askToken, tell } from "./ask.js";
import * as clock from "./clock.js";
import { find, make } from "./dom.js";
import { mayReload, reload } from "./reload.js";
import { store } from "./store.js";
import { count } from "./values.js";

const THEME = "multidrop-theme";
const THEMES = [
  ["", "same as system"],
  ["light", "light"],
  ["dark", "dark"],
];
const keys = () => [
  ["↑ ↓", "another drive"],
  ["Enter", "open the drive"],
  ["/", "filter"],
  [`1 to ${document.querySelectorAll("nav a:not([hidden])").length}`, "views"],
  ["s", "stop the selected drive (asks first)"],
  ["Shift S", "stop all drives (asks first)"],
  ["u", "UTC or local time"],
  ["a, b", "markers in trends"],
  ["Esc", "close; undo a zoom"],
];

export function begin() {
  setTheme(kept());
  find("#more").addEventListener("click", show);
  find("#role").addEventListener("click", show);
  find("#clock").addEventListener("click", clock.switchZone);
  labelClock();
  addEventListener("timezone", labelClock);
}

function kept() {
  try {
    return localStorage.getItem(THEME) ?? "";
  } catch {
    return "";
  }
}

function labelClock() {
  find("#clock").title = clock.isUtc()
    ? "All times are UTC. Press to switch to local time."
    : "All times are this device's local time. Press to switch to UTC.";
}

function setTheme(name) {
  if (name) document.documentElement.dataset.theme = name;
  else delete document.documentElement.dataset.theme;
  try {
    localStorage.setItem(THEME, name);
  } catch {
    /* the browser forbids storage: the choice lasts until the page is closed */
  }
  dispatchEvent(new Event("theme"));
}

async function show() {
  const radio = (group, value, title, is, what) => {
    const box = make("input", { type: "radio", name: group, value, onchange: what });
    box.checked = is;
    return make("label", {}, box, title);
  };
  const may = store.plant?.may ?? {};
  const contents = [
    make(
      "fieldset",
      {},
      make("legend", {}, "Times"),
      radio("zone", "UTC", "UTC", clock.isUtc(), () => clock.isUtc() || clock.switchZone()),
      radio(
        "zone",
        "local",
        `local (${Intl.DateTimeFormat().resolvedOptions().timeZone})`,
        !clock.isUtc(),
        () => clock.isUtc() && clock.switchZone(),
      ),
    ),
    make(
      "fieldset",
      {},
      make("legend", {}, "Theme"),
      THEMES.map(([value, title]) => radio("theme", value, title, kept() === value, () => setTheme(value))),
    ),
    make(
      "p",
      {},
      `Your right: ${may.role ?? "look"}. You may write ${count(may.write?.length ?? 0, "register")}. ` +
        `Version ${store.plant?.version ?? "–"}.`,
    ),
    make(
      "dl",
      { class: "help" },
      keys().flatMap(([key, what]) => [make("dt", {}, make("kbd", {}, key)), make("dd", {}, what)]),
    ),
  ];
  const choice = await tell("Settings", contents, [
    ...(mayReload() ? [["reload", "Reload the plant file", "calm"]] : []),
    ["token", "Enter a token", "calm"],
    ["forget", "Sign out", "calm"],
  ]);
  if (choice === "reload") await reload();
  if (choice === "token")
    await askToken("A token gives the right to stop or to write. Ask the gateway's administrator for one.");
  if (choice === "forget") {
    await post("api/forget", {}).catch(error =>
      tell("Not signed out", make("p", { class: "bad" }, error.message)),
    );
    dispatchEvent(new Event("signed"));
  }
}
