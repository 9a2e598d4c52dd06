// What the gateway recorded: series of a span of time, and links that save them.

import { get, query } from "./api.js";

export const label = (drive, register) => `${drive}.${register}`;

// Return {series: {label: {time, least, mean, most}}, step_ms}. Raises Refused where no history is kept.
export const read = (labels, from, to, points) =>
  get(
    `api/history?${query([
      ...labels.map(name => ["series", name]),
      ["from", Math.floor(from)],
      ["to", Math.ceil(to)],
      ["points", points],
    ])}`,
  );

export const exportLink = (labels, from, to, format) =>
  `api/export?${query([
    ...labels.map(name => ["series", name]),
    ["from", Math.floor(from)],
    ["to", Math.ceil(to)],
    ["format", format],
  ])}`;
