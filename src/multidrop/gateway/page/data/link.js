// The page's connection to the gateway: one pending request for the next frame (the plant's state), and the
// newest frame's age.

import { plantPath, t } from "../texts.js";
import { errorOf, get } from "./api.js";
import { store, takeFrame, takeMinute, takePlant } from "./store.js";

const PATIENCE_MS = 25000; // request timeout; the gateway answers after 20 s even without news
const AGAIN_MS = 500;
const NONE = -1; // frame number in requests of a page that has no frame yet
const HIDDEN_MS = 1000; // interval of requests from a hidden tab, which holds no connection open

export const link = { why: "" };
let under = null; // AbortController of the pending request

// The difference of the gateway's clock and this device's clock in ms, from the Date headers of answers. A
// Date header has whole seconds, so the difference is only known to lie between `least` and `most`. If 0 lies
// between them too, no correction is made.
const skew = { least: -Infinity, most: Infinity };

function learnSkew(date, sent, received) {
  const told = Date.parse(date ?? "");
  if (Number.isNaN(told)) return;
  const least = told - received,
    most = told + 1000 - sent;
  if (least > skew.most || most < skew.least)
    Object.assign(skew, { least, most }); // one of the clocks was set
  else Object.assign(skew, { least: Math.max(least, skew.least), most: Math.min(most, skew.most) });
}

export const correction = () => (skew.least > 0 ? skew.least : skew.most < 0 ? skew.most : 0);

// Return the gateway's present time in ms. It is computed from this device's wall clock and from its
// monotonic clock. The later result counts, because the wall clock may be set back.
export const now = () => Math.max(Date.now() + correction(), store.time + performance.now() - store.came);

const pause = ms => new Promise(done => setTimeout(done, ms));

// A browser allows six connections to a gateway, and each open page occupies one with its pending
// request for a frame. So with six open pages, a command would wait. Before a page sends a command, all pages
// therefore cancel their requests for frames. The other pages wait AGAIN_MS before they request frames again.
const pages = new BroadcastChannel("command");
let restMs = 0; // pause before the next request
addEventListener("command", () => {
  pages.postMessage(null);
  under?.abort();
});
pages.addEventListener("message", () => {
  restMs = AGAIN_MS;
  under?.abort();
});

export async function run() {
  let n = NONE,
    isKnown = false;
  for (;;) {
    try {
      if (restMs) await pause(restMs);
      restMs = 0;
      if (!isKnown) {
        takePlant(await get(plantPath));
        takeMinute(await get("api/minute").catch(() => ({})));
        [n, isKnown] = [NONE, true];
      }
      const told = await newer(document.hidden ? NONE : n);
      [store.isLost, link.why] = [false, ""];
      if (told) {
        takeFrame(told);
        n = store.frame.n;
        isKnown = store.frame.revision === store.plant.revision;
      }
      if (document.hidden) await pause(HIDDEN_MS);
    } catch (error) {
      if (error.name === "AbortError") continue;
      [store.isLost, link.why, isKnown] = [true, error.message, false];
      if (error.status === 401) dispatchEvent(new Event("stranger"));
      await pause(AGAIN_MS);
    }
  }
}

// Return the changes since frame `n`, or a whole frame if the gateway has forgotten frame `n`. Return null
// without a newer frame.
async function newer(n) {
  const sent = Date.now();
  under = new AbortController();
  let response;
  try {
    const signal = AbortSignal.any([under.signal, AbortSignal.timeout(PATIENCE_MS)]);
    response = await fetch(`api/frame?after=${n}`, { signal, cache: "no-store", priority: "low" });
    learnSkew(response.headers.get("date"), sent, Date.now());
    if (response.status === 304) return null;
    if (response.ok) return await response.json();
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Error(
      error.name === "TimeoutError"
        ? t("The gateway does not answer.")
        : t("The gateway cannot be reached."),
    );
  }
  const body = await response.json().catch(() => null);
  throw new Error(errorOf(response, body));
}
