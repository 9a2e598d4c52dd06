// A plot of one register of several drives, from recorded values. A band shows each drive's least and largest
// value.

import { label } from "../../data/history.js";
import { holdsFor, store } from "../../data/store.js";
import { said } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { fill, make, named } from "../../ui/dom.js";
import { dashes, heldAt, join, line, makePlot, summary, swatch, translucent, wide } from "../../ui/plots.js";
import { number, registerName } from "../../ui/values.js";
import * as markers from "./markers.js";
import * as picker from "./picker.js";

// Make the plot of one register of the drives. `set` is called with the time range that the user drags the
// mouse over.
export function makeTrend(place, { register, unit, drives }, told, { view, set, count, stepMs }) {
  const spec = store.drives.get(drives[0]).registers.get(register);
  const name = registerName(spec),
    out = make("output"),
    box = make("div", { class: "plotbox", role: "img" });
  place.append(
    make(
      "div",
      { class: "plot" },
      make("div", { class: "plothead" }, make("b", {}, [name, said(unit)].filter(Boolean).join(", ")), out),
      box,
    ),
  );
  const series = [],
    bands = [],
    tables = [],
    summaries = [];
  for (const drive of drives) {
    const { time, least, mean, most } = told[label(drive, register)],
      index = picker.index(drive),
      k = series.length + 1;
    const bare = { stroke: "transparent", points: { show: false } };
    series.push(bare, bare, line(index, drive, dashes(index)));
    bands.push({ series: [k, k + 1], fill: translucent(index, 0.22) });
    tables.push([time, most, least, mean]);
    summaries.push(summary(drive, mean, said(unit), spec.digits));
  }
  const marks = drives.map(drive => (drives.length > 1 ? swatch(picker.index(drive)) : null)),
    widths = tables.map(([, most, least]) => widest([...most, ...least], spec.digits)),
    holds = drives.map(drive => holdsFor(drive, register) + stepMs),
    legend = u => fill(out, under(u, { drives, marks, widths, holds, spec }));
  const height = Math.max(150, Math.min(300, (innerHeight - 300) / count));
  const plot = makePlot(box, join(tables), {
    series,
    bands,
    height,
    range: wide(unit === "Hz" ? 0.5 : 1),
    sync: "trends",
    cursor: { drag: { x: true, y: false, setScale: false } },
    window: () => [view.from / 1000, view.to / 1000],
    hooks: {
      setCursor: [legend],
      setSelect: [
        u => {
          if (u.select.width > 4)
            set(
              u.posToVal(u.select.left, "x") * 1000,
              u.posToVal(u.select.left + u.select.width, "x") * 1000,
              false,
            );
        },
      ],
      draw: [u => markers.mark(u)],
    },
  });
  legend(plot);
  box.setAttribute("aria-label", `${name}. ${summaries.join(". ")}`);
  return { plot, drives, holds, spec, register, unit };
}

// Return the length, in characters, of the longest value's text.
function widest(values, digits) {
  const there = values.filter(value => value !== null && value !== undefined),
    ends = [there.reduce((a, b) => Math.min(a, b), 0), there.reduce((a, b) => Math.max(a, b), 0)];
  return Math.max(...ends.map(value => number(value, digits).length));
}

// Return the legend: each drive's value at the cursor. Without a cursor, the drives' names take the same
// space, so that the plot does not move when the cursor enters it.
function under(u, { drives, marks, widths, holds, spec }) {
  const i = u.cursor.idx ?? null,
    at = i === null ? undefined : u.data[0][i];
  if (at === undefined && drives.length < 2) return [];
  return [
    ...drives.map((name, k) => {
      const value = at === undefined ? undefined : heldAt(u, 3 + 3 * k, at, holds[k]);
      const told = value === undefined ? "" : value === null ? "–" : number(value, spec.digits);
      return make("span", {}, marks[k], named(name), " ", wideText(told, widths[k]));
    }),
    wideText(at === undefined ? "" : clock.time(at * 1000), 8),
  ];
}

function wideText(text, width) {
  const found = make("span", { class: "wide" }, text);
  found.style.minWidth = `${width}ch`;
  return found;
}
