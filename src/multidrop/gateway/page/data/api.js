// Requests to the gateway. A failed request throws an Error whose message is a sentence for the user.

import { said, t } from "../texts.js";

export class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

const PATIENCE_MS = 15000;

// Return the sentence about a failed request that the user sees.
export const errorOf = ({ status }, body) =>
  body?.error ? said(body.error) : t("The gateway answered with status {n}.", { n: status });

async function ask(path, options, patience, answered = () => {}) {
  let response;
  try {
    response = await fetch(path, { cache: "no-store", signal: AbortSignal.timeout(patience), ...options });
  } catch (error) {
    throw new Refused(
      0,
      error.name === "TimeoutError"
        ? t("No answer from the gateway for {n} s.", { n: Math.round(patience / 1000) })
        : t("The gateway cannot be reached."),
    );
  }
  answered();
  const body = await response.json().catch(() => null);
  if (!response.ok) throw new Refused(response.status, errorOf(response, body));
  if (body === null) throw new Refused(0, t("The gateway's answer was cut off."));
  return body;
}

export const get = (path, patience = PATIENCE_MS) => ask(path, {}, patience);

// Send a command. Browsers open at most six connections to a host for all tabs together, and tabs that wait
// for frames may occupy all six. So a command gets a higher priority than other queued requests. `answered`
// is called when the head of the answer has arrived.
export const post = (path, body, patience = PATIENCE_MS, answered = undefined) =>
  ask(
    path,
    {
      method: "POST",
      priority: "high",
      headers: { "content-type": "application/json" },
      body: JSON.stringify(body),
    },
    patience,
    answered,
  );

export const query = pairs => new URLSearchParams(pairs).toString();
