// The page's texts in the viewer's language. Code names a text by its English wording; texts.toml has the
// translations. If the translations could not be fetched, the page is in English and still works.

const texts = new Map(Object.entries(await globalThis.texts));
// Placeholders in the gateway's texts, and patterns of their values: a number, or a register's name.
const VALUES = { "{n}": /\d+(\.\d+)?/, "{name}": /^\w+/ };

export const LANGUAGES = [
  ["en", "English"],
  ["ru", "Русский"],
  ["zh", "中文"],
];
export const language = document.documentElement.lang;

// The path for requests of the plant's description, with the chosen language. Without a choice, the gateway
// uses the languages that the browser sends.
export const plantPath =
  document.documentElement.dataset.chosen === undefined ? "api/plant" : `api/plant?lang=${language}`;

// Return the pieces of a translated text, with a text or an element in place of each placeholder such as
// {drive}.
export const pieces = (english, values = {}) =>
  (texts.get(english) ?? english).split(/\{(\w+)\}/).map((piece, i) => (i % 2 ? values[piece] : piece));

export const t = (english, values) => pieces(english, values).join("");

// Return the translation of a text from the gateway, such as "unconfirmed: no reply" or "undervoltage (UV)".
// Pieces without a translation stay English.
export function said(english) {
  const [head, ...rest] = String(english).split(": ");
  return texts.get(english) ?? (rest.length ? `${word(head)}: ${said(rest.join(": "))}` : word(head));
}

function word(english) {
  const [plain, code = ""] = english.split(/(?= \([\w-]+\)$)/);
  return (texts.get(plain) ?? withValue(plain) ?? plain) + code;
}

// Return the translation of a text that contains one value, such as "status is not polled"; null if there is
// none.
function withValue(plain) {
  for (const [placeholder, pattern] of Object.entries(VALUES)) {
    const found = texts.get(plain.replace(pattern, placeholder));
    if (found) return found.replace(placeholder, pattern.exec(plain)[0]);
  }
  return null;
}

// Return a text with a full stop at its end.
export const sentence = text => (/[.。]$/.test(text) ? text : `${text}.`);

// Store the choice of a language in this browser, and show the page in this language.
export function choose(name) {
  try {
    localStorage.setItem("multidrop-language", name);
  } catch {
    return; // the browser forbids storage: the page stays in the browser's language
  }
  location.reload();
}
