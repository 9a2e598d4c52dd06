// Load the page again where a script could not be fetched: a network that changes breaks off all requests.

const MOST_TIMES = 3,
  PAUSE_MS = 500,
  TIMES = "times loaded again";

// Not while a person is asked something, such as whether to stop.
const loadAgain = () => document.querySelector("dialog[open]") || location.reload();

addEventListener(
  "error",
  event => {
    const times = Number(sessionStorage.getItem(TIMES));
    if (!event.target.matches?.("script[type=module]") || times >= MOST_TIMES) return;
    sessionStorage.setItem(TIMES, times + 1);
    setTimeout(loadAgain, PAUSE_MS);
  },
  true,
);
addEventListener("load", () => document.body.dataset.begun && sessionStorage.removeItem(TIMES));
