// Two markers in the trends, A and B, with a table of the values at each marker and of their differences. A
// third marker shows the moment of a trigger.

import { label } from "../../data/history.js";
import { said, t } from "../../texts.js";
import * as clock from "../../ui/clock.js";
import { colour, fill, find, make, named, tableHead } from "../../ui/dom.js";
import { heldAt } from "../../ui/plots.js";
import { number } from "../../ui/values.js";

const TRIGGER = t("trigger");
const marks = { A: null, B: null, [TRIGGER]: null }; // by marker: its time in ms, or null
let plots = () => [],
  view = () => ({ from: 0, to: 0 });

// Set up the markers. `getPlots` returns the plots of the trends, and `getView` the time range that they
// show.
export function begin(getPlots, getView) {
  [plots, view] = [getPlots, getView];
}

// Return the buttons of the two markers. A button puts its marker at the mouse cursor, or without a cursor
// into the shown range. Arrow keys move the marker.
export const buttons = () =>
  ["A", "B"].map(name =>
    make(
      "button",
      {
        type: "button",
        title: t("Marker {name}: at the cursor; arrow keys move it; Delete removes it", { name }),
        "aria-label": t("Marker {name}", { name }),
        id: `mark-${name}`,
        onclick: () => place(name),
        onkeydown: event => move(event, name),
      },
      name,
    ),
  );

// Put a marker at the mouse cursor. Called by the buttons, and by the keys a and b.
export function place(name) {
  const { from, to } = view(),
    u = plots()[0]?.plot,
    i = u?.cursor.idx;
  const under = u && u.cursor.left >= 0 && i !== null && i !== undefined ? u.data[0][i] * 1000 : null;
  set(name, under ?? from + (to - from) * (name === "A" ? 1 / 3 : 2 / 3));
}

function move(event, name) {
  const { from, to } = view(),
    step = (to - from) / (event.shiftKey ? 20 : 200);
  if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
    set(
      name,
      Math.max(
        from,
        Math.min(to, (marks[name] ?? (from + to) / 2) + (event.key === "ArrowLeft" ? -step : step)),
      ),
    );
  } else if (event.key === "Delete" || event.key === "Backspace") set(name, null);
  else return;
  event.preventDefault();
}

function set(name, ms) {
  marks[name] = ms;
  for (const { plot } of plots()) plot.redraw(false);
  draw();
}

// Put the third marker at the moment of a trigger. It is drawn when the plots are drawn next.
export const setTrigger = ms => (marks[TRIGGER] = ms);

// Draw the markers into a plot. uPlot calls this after it has drawn the plot.
export function mark(u) {
  for (const [name, ms] of Object.entries(marks)) {
    if (ms === null || ms < view().from || ms > view().to) continue;
    const x = Math.round(u.valToPos(ms / 1000, "x", true)),
      { top, height } = u.bbox,
      pen = u.ctx,
      scale = devicePixelRatio;
    pen.save();
    [pen.strokeStyle, pen.fillStyle, pen.lineWidth] = [colour("text"), colour("text"), scale];
    pen.beginPath();
    pen.moveTo(x, top);
    pen.lineTo(x, top + height);
    pen.stroke();
    pen.font = `bold ${11 * scale}px system-ui, sans-serif`;
    [pen.textAlign, pen.textBaseline] = ["left", "top"];
    pen.fillText(name, x + 3 * scale, top + 2 * scale);
    pen.restore();
  }
}

// Return a column's value at a time (ms), or null if the column has no current value at that time.
const at = (u, column, ms, holdMs) => (ms === null ? null : heldAt(u, column, ms / 1000, holdMs));

// Write the table of the values at the markers.
export function draw() {
  const place = find("#marks");
  if (marks.A === null && marks.B === null) {
    fill(place);
    return;
  }
  const rows = plots().flatMap(({ plot, drives, holds, spec, register, unit }) =>
    drives.map((drive, k) => {
      const [a, b] = [marks.A, marks.B].map(ms => at(plot, 3 + 3 * k, ms, holds[k])),
        write = v => (v === null ? "–" : number(v, spec.digits));
      return make(
        "tr",
        {},
        make("th", { scope: "row" }, named(label(drive, register))),
        make("td", {}, write(a)),
        make("td", {}, write(b)),
        make("td", {}, a === null || b === null ? "–" : write(b - a)),
        make("td", {}, said(unit)),
      );
    }),
  );
  const told = ms => (ms === null ? "–" : clock.milli(ms));
  const between = marks.A === null || marks.B === null ? "–" : clock.lasting(Math.abs(marks.B - marks.A));
  fill(
    place,
    make(
      "table",
      { class: "plain" },
      make("caption", { class: "hidden" }, t("Values at the markers")),
      tableHead(["", `A ${told(marks.A)}`, `B ${told(marks.B)}`, `B − A, ${between}`, t("unit")]),
      make("tbody", {}, rows),
    ),
  );
}
