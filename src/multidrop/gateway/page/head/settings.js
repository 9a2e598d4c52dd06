// Settings of this browser: time zone, theme, token, and a list of keyboard shortcuts.

import { post } from "../data/api.js";
import { store } from "../data/store.js";
import { LANGUAGES, choose, language, said, t } from "../texts.js";
import * as clock from "../ui/clock.js";
import { askToken, tell } from "../ui/dialog.js";
import { find, make } from "../ui/dom.js";
import { mayReload, reload } from "./reload.js";

const THEME = "multidrop-theme";
const THEMES = [
  ["", t("same as system")],
  ["light", t("light")],
  ["dark", t("dark")],
];
const keys = () => [
  ["↑ ↓", t("another drive")],
  ["Enter", t("open the drive")],
  ["/", t("filter")],
  [
    t("{low} to {high}", { low: 1, high: document.querySelectorAll("nav a:not([hidden])").length }),
    t("views"),
  ],
  ["s", t("stop the selected drive (asks first)")],
  ["Shift S", t("stop all drives (asks first)")],
  ["u", t("UTC or local time")],
  ["a, b", t("markers in trends")],
  ["Esc", t("close; undo a zoom")],
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
    ? t("All times are UTC. Press to switch to local time.")
    : t("All times are this device's local time. Press to switch to UTC.");
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
  const may = store.plant?.may ?? {},
    n = may.write?.length ?? 0;
  const contents = [
    make(
      "fieldset",
      {},
      make("legend", {}, t("Times")),
      radio("zone", "UTC", "UTC", clock.isUtc(), () => clock.isUtc() || clock.switchZone()),
      radio(
        "zone",
        "local",
        t("local ({zone})", { zone: Intl.DateTimeFormat().resolvedOptions().timeZone }),
        !clock.isUtc(),
        () => clock.isUtc() && clock.switchZone(),
      ),
    ),
    make(
      "fieldset",
      {},
      make("legend", {}, t("Language")),
      LANGUAGES.map(([code, title]) =>
        radio("language", code, title, code === language, () => choose(code)),
      ),
    ),
    make(
      "fieldset",
      {},
      make("legend", {}, t("Theme")),
      THEMES.map(([value, title]) => radio("theme", value, title, kept() === value, () => setTheme(value))),
    ),
    make(
      "p",
      {},
      t(
        n === 1
          ? "Your right: {role}. You may write {n} register. Version {version}."
          : "Your right: {role}. You may write {n} registers. Version {version}.",
        { role: said(may.role ?? "look"), n, version: store.plant?.version ?? "–" },
      ),
    ),
    make(
      "dl",
      { class: "help" },
      keys().flatMap(([key, what]) => [make("dt", {}, make("kbd", {}, key)), make("dd", {}, what)]),
    ),
  ];
  const choice = await tell(t("Settings"), contents, [
    ...(mayReload() ? [["reload", t("Reload the plant file"), "calm"]] : []),
    ["token", t("Enter a token"), "calm"],
    ["forget", t("Sign out"), "calm"],
  ]);
  if (choice === "reload") await reload();
  if (choice === "token")
    await askToken(
      t("A token gives the right to stop or to write. Ask the gateway's administrator for one."),
    );
  if (choice === "forget") {
    await post("api/forget", {}).catch(error =>
      tell(t("Not signed out"), make("p", { class: "bad" }, error.message)),
    );
    dispatchEvent(new Event("signed"));
  }
}
