// Choose the page's language, and reload the page if a script could not be fetched. A network change, for
// example, aborts all requests.

const MOST_TIMES = 3,
  PAUSE_MS = 500;
const TRANSLATED = ["ru", "zh"]; // languages of texts.toml; the page's own language is English
const TEXTS_MS = 8000; // time limit for fetching texts; without them the page is in English
const root = document.documentElement;

function chosenLanguage() {
  try {
    return localStorage.getItem("multidrop-language");
  } catch {
    return null; // the browser forbids storage
  }
}

// Return the page's texts in the viewer's language, by their English wording.
async function fetchTexts() {
  const known = tag => ["en", ...TRANSLATED].find(name => name === tag.split("-")[0]);
  const chosen = known(chosenLanguage() ?? ""),
    language = chosen ?? navigator.languages.map(known).find(Boolean) ?? "en";
  if (chosen) root.dataset.chosen = "";
  if (language === "en") return {};
  root.classList.add("untranslated"); // hides the page, so that no English text flashes up
  try {
    const signal = AbortSignal.timeout(TEXTS_MS),
      response = await fetch(`page/texts.${language}.json`, { signal }),
      texts = await response.json();
    if (response.ok) root.lang = language;
    return response.ok ? texts : {};
  } catch {
    return {};
  }
}

async function translatePage() {
  const texts = await globalThis.texts;
  if (document.readyState === "loading")
    await new Promise(done => document.addEventListener("readystatechange", done, { once: true }));
  const nodes = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (nodes.nextNode()) {
    const { data } = nodes.currentNode;
    nodes.currentNode.data = texts[data.trim()] ?? data;
  }
  for (const name of ["aria-label", "placeholder"])
    for (const element of document.querySelectorAll(`[${name}]`)) {
      const text = element.getAttribute(name);
      element.setAttribute(name, texts[text] ?? text);
    }
  root.classList.remove("untranslated");
}

globalThis.texts = fetchTexts();
translatePage();

// Do not reload the page while a dialog is open, because it may be the question about a stop.
const loadAgain = () => document.querySelector("dialog[open]") || location.reload();

addEventListener(
  "error",
  event => {
    const times = history.state?.timesLoadedAgain ?? 0; // a browser may forbid storage
    if (!event.target.matches?.("script[type=module]") || times >= MOST_TIMES) return;
    history.replaceState({ timesLoadedAgain: times + 1 }, "");
    setTimeout(loadAgain, PAUSE_MS);
  },
  true,
);
addEventListener("load", () => document.body.dataset.begun && history.replaceState(null, ""));
