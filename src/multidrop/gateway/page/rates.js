// Rates of the last minute, from the gateway's counts: exchanges of a line, and a drive's share of misses.

import { get } from "./api.js";

const OVER_MS = 60000;

let readings = []; // [ms, what api/lines told], oldest first

// Ask for the counts. Raises Refused.
export async function fetchLines() {
  const told = await get("api/lines"),
    at = performance.now();
  readings.push([at, told]);
  while (readings.length > 2 && at - readings[1][0] > OVER_MS) readings.shift();
  return told;
}

// Ask now and then, for the table of drives; what cannot be had is not known.
export const keepUp = () => fetchLines().catch(() => (readings = []));

function counts(part) {
  const [first, last] = [readings[0], readings[readings.length - 1]];
  if (readings.length < 2) return null;
  const before = part(first[1]),
    after = part(last[1]);
  if (!before || !after || after.exchanges < before.exchanges) return null; // it began anew
  return {
    seconds: (last[0] - first[0]) / 1000,
    exchanges: after.exchanges - before.exchanges,
    misses: after.misses - before.misses,
  };
}

// Return the share of a drive's requests that were missed, or null where that is not known.
export function missed(line, drive) {
  const found = counts(told => told[line]?.drives?.[drive]);
  return found && found.exchanges ? found.misses / found.exchanges : null;
}

// Return a line's exchanges in a second, or null.
export function line(name) {
  const found = counts(told => sum(Object.values(told[name]?.drives ?? {})));
  return found && found.seconds ? found.exchanges / found.seconds : null;
}

const sum = drives => ({
  exchanges: drives.reduce((total, drive) => total + (drive?.exchanges ?? 0), 0),
  misses: drives.reduce((total, drive) => total + (drive?.misses ?? 0), 0),
});
