// All parameters of the chosen drive, read on request, as a table and as files. The page cannot write them.

import { get, query } from "../../data/api.js";
import { said, t } from "../../texts.js";
import { fill, find, make, tableHead } from "../../ui/dom.js";
import { words } from "../../ui/values.js";

const FORMATS = ["toml", "csv"];
const AGAIN_MS = 1000; // interval of requests while the gateway reads the parameters

let name = null;

export function build(spec) {
  name = spec.name;
  const section = make("section", { id: "parameters", "aria-label": t("Parameters") });
  ask(spec.name, {});
  return section;
}

const path = (drive, pairs) => `api/parameters/${encodeURIComponent(drive)}?${query(pairs)}`;

// Fetch the parameters and show them, again and again while the gateway reads them. If a request fails, its
// error is shown in place of the data.
async function ask(drive, pairs) {
  const found = await get(path(drive, pairs)).catch(error => ({ state: "failed", error: error.message }));
  if (drive !== name || !find("#parameters")) return;
  fill(find("#parameters"), make("h3", {}, t("Parameters")), ...shown(drive, found));
  if (found.state === "reading") setTimeout(() => drive === name && ask(drive, {}), AGAIN_MS);
}

function shown(drive, found) {
  if (found.state === "reading")
    return [
      note(
        found.total
          ? t("Read {n} of {all} addresses.", { n: found.done, all: found.total })
          : t("Reading starts."),
      ),
    ];
  const button = make(
    "button",
    { type: "button", onclick: () => ask(drive, { read: 1 }) },
    found.state === "read" ? t("Read again") : t("Read all parameters"),
  );
  if (found.state === "failed") return [note(said(found.error)), acts(button)];
  if (found.state !== "read") return [acts(button)];
  return [
    note(t("{n} parameters, read at {time}.", { n: found.parameters.length, time: found.saved })),
    acts(button, ...FORMATS.map(format => file(drive, format))),
    make(
      "table",
      { class: "plain" },
      tableHead([t("Parameter"), t("Value"), t("Factory")]),
      make("tbody", {}, found.parameters.map(row)),
    ),
  ];
}

const acts = (...buttons) => make("div", { class: "acts" }, buttons);

const note = text => make("p", { class: "note" }, text);

const file = (drive, format) =>
  make(
    "a",
    { class: "button", href: path(drive, { format }), download: "" },
    t("Save as {format}", { format: format.toUpperCase() }),
  );

function row({ code, name: register, value, factory }) {
  const label = register ? make("small", {}, words(register)) : null;
  return make(
    "tr",
    {},
    make("th", { scope: "row" }, `${code} `, label),
    make("td", {}, value),
    make("td", {}, factory),
  );
}
