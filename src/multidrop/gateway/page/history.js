// What the gateway recorded: series of a span of time, and links that save them.

import { get, query } from "./api.js";
import { unit } from "./values.js";

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

// Return the unit of a series: a name may have been another drive's when it was recorded.
export const unitOf = (told, spec) => told.unit ?? unit(spec);

// Return true where a series is of the same unit as its register is now.
export const isPresent = (told, spec) => unitOf(told, spec) === unit(spec);

// Return a sentence about each series of which a part is not drawn, since it has another unit.
export const leftOut = series =>
  Object.entries(series)
    .filter(([, told]) => told.left_out?.length)
    .map(([name, told]) => {
      const others = told.left_out.map(other => other || "no unit").join(", ");
      return `${name} was recorded in ${others} too, which is not drawn.`;
    });

export const exportLink = (labels, from, to, format) =>
  `api/export?${query([
    ...labels.map(name => ["series", name]),
    ["from", Math.floor(from)],
    ["to", Math.ceil(to)],
    ["format", format],
  ])}`;
