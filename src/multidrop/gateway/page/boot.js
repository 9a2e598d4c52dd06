// Reload the page if a script could not be fetched: a network change aborts all requests.

const MOST_TIMES = 3,
  PAUSE_MS = 500;

// Do not reload while a dialog is open: the dialog may be for a stop.
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
