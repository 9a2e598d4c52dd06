"""Timing diagrams as SVG: lanes that show the traffic on the wire from left to right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

WIDTH, LEFT, RIGHT = 760, 92, 12  # px
LANE, BOX, GAP = 30, 22, 14
FONT = "font-family='Helvetica, Arial, sans-serif' font-size='12'"
COLOURS = {"request": "#0072B2", "reply": "#009E73", "late": "#D55E00", "echo": "#E69F00", "wait": "none"}


@dataclass(frozen=True)
class Span:
    """A box in a lane, with its times in the diagram's own unit."""

    begin: float
    end: float
    text: str
    kind: str  # a key of COLOURS; "wait" is drawn as a dimension with arrows


@dataclass(frozen=True)
class Mark:
    """A vertical line through all lanes."""

    at: float
    text: str


@dataclass(frozen=True)
class Diagram:
    """Lanes by name, marks, and the total time."""

    length: float
    lanes: Sequence[tuple[str, Sequence[Span]]]
    marks: Sequence[Mark] = ()
    note: str = ""


# Times in ms at 9600 baud, 8N1: a read of ten registers, response delay 2 ms. Some diagrams are not to scale.
DIAGRAMS = {
    "exchange": Diagram(
        46,
        [
            ("client", [Span(3.6, 12.0, "request", "request")]),
            ("drive", [Span(14.0, 40.0, "reply", "reply")]),
            (
                "",
                [
                    Span(0, 3.6, "t3.5", "wait"),
                    Span(3.6, 12.0, "8.3 ms", "wait"),
                    Span(12.0, 14.0, "2.0", "wait"),
                    Span(14.0, 40.0, "26.0 ms", "wait"),
                    Span(40.0, 43.6, "t3.5", "wait"),
                ],
            ),
        ],
        note="9600 baud, 8N1: 8 characters, response delay 2 ms, 25 characters; t3.5 = 3.6 ms; 40 ms in all",
    ),
    "blocks": Diagram(
        72,
        [
            (
                "two reads",
                [
                    Span(3.6, 12.0, "10H, 2", "request"),
                    Span(17.0, 26.4, "reply", "reply"),
                    Span(30.0, 38.4, "18H, 1", "request"),
                    Span(43.4, 50.7, "reply", "reply"),
                ],
            ),
            (
                "one read",
                [Span(3.6, 12.0, "10H, 9", "request"), Span(17.0, 41.0, "reply, 6 unused", "reply")],
            ),
        ],
        [Mark(41.0, "41 ms"), Mark(50.7, "51 ms")],
        note="registers 10H, 11H and 18H, response delay 5 ms, 9600 baud: here one read is quicker",
    ),
    "echo": Diagram(
        46,
        [
            ("client", [Span(3, 13, "06 write", "request")]),
            ("drive", [Span(24, 34, "confirmation", "reply")]),
            ("received", [Span(4, 14, "echo", "echo"), Span(24, 34, "confirmation", "reply")]),
        ],
        [Mark(13, "request has left")],
        note="an echo and the confirmation of a write are the same bytes",
    ),
    "late": Diagram(
        60,
        [
            ("client", [Span(2, 9, "read A", "request"), Span(28, 35, "read B", "request")]),
            ("drive", [Span(38, 47, "answer to A", "late"), Span(50, 59, "answer to B", "reply")]),
            ("", [Span(9, 24, "time-out", "wait")]),
        ],
        [Mark(24, "A has timed out")],
        note="the first reply after the second request answers the first one",
    ),
}


def draw(name: str) -> str:
    """Return the SVG of a diagram."""
    diagram = DIAGRAMS[name]
    top = 22 if diagram.marks else 8
    bottom = top + len(diagram.lanes) * LANE
    height = bottom + (26 if diagram.note else 6)
    parts = [
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {height}' width='{WIDTH}' {FONT}>",
        f"<rect width='{WIDTH}' height='{height}' fill='#ffffff'/>",
    ]
    scale = (WIDTH - LEFT - RIGHT) / diagram.length
    for number, (lane, spans) in enumerate(diagram.lanes):
        y = top + number * LANE
        parts.append(f"<text x='8' y='{y + 16}' fill='#333333'>{escape(lane)}</text>")
        if any(span.kind != "wait" for span in spans):
            parts.append(
                f"<line x1='{LEFT}' y1='{y + BOX}' x2='{WIDTH - RIGHT}' y2='{y + BOX}' stroke='#bbbbbb'/>"
            )
        parts += [_span(span, y, scale) for span in spans]
    parts += [_mark(mark, bottom, scale) for mark in diagram.marks]
    if diagram.note:
        parts.append(f"<text x='{LEFT}' y='{height - 8}' fill='#555555'>{escape(diagram.note)}</text>")
    return "\n".join([*parts, "</svg>", ""])


def _span(span: Span, y: float, scale: float) -> str:
    x, width = LEFT + span.begin * scale, (span.end - span.begin) * scale
    middle = x + width / 2
    if span.kind == "wait":
        return (
            f"<line x1='{x:.1f}' y1='{y + 4}' x2='{x:.1f}' y2='{y + 16}' stroke='#777777'/>"
            f"<line x1='{x + width:.1f}' y1='{y + 4}' x2='{x + width:.1f}' y2='{y + 16}' stroke='#777777'/>"
            f"<line x1='{x:.1f}' y1='{y + 10}' x2='{x + width:.1f}' y2='{y + 10}' stroke='#777777'/>"
            f"<text x='{middle:.1f}' y='{y + 25}' text-anchor='middle' fill='#333333' font-size='11'>"
            f"{escape(span.text)}</text>"
        )
    return (
        f"<rect x='{x:.1f}' y='{y}' width='{width:.1f}' height='{BOX}' fill='{COLOURS[span.kind]}'/>"
        f"<text x='{middle:.1f}' y='{y + 15}' text-anchor='middle' fill='#ffffff'>{escape(span.text)}</text>"
    )


def _mark(mark: Mark, bottom: float, scale: float) -> str:
    x = LEFT + mark.at * scale
    return (
        f"<line x1='{x:.1f}' y1='18' x2='{x:.1f}' y2='{bottom}' stroke='#555555' stroke-dasharray='4 3'/>"
        f"<text x='{x:.1f}' y='13' text-anchor='middle' fill='#555555' font-size='11'>"
        f"{escape(mark.text)}</text>"
    )
