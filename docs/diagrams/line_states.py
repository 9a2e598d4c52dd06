"""Draw the states of a line from the core's own table: `python docs/diagrams/line_states.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from multidrop._core import ffi, lib

PICTURE = Path(__file__).with_suffix(".svg")
STEP, TOP, LEFT, WIDTH, HEIGHT = 90, 40, 330, 170, 40  # of the boxes, in px


def names(kind: str) -> list[str]:
    """Return the names in an enum of the core, in order; its last member, the count, is left out."""
    elements = ffi.typeof(f"enum {kind}").elements
    return [elements[number].removeprefix("MD_").replace("_", " ").lower() for number in sorted(elements)][
        :-1
    ]


STATES, EVENTS = names("md_line_state"), names("md_line_event")


def transitions() -> dict[tuple[int, int], list[str]]:
    """Return the events that lead from one state to another."""
    found: dict[tuple[int, int], list[str]] = {}
    for state in range(len(STATES)):
        for number, event in enumerate(EVENTS):
            following = lib.md_line_follows[state][number]
            if following >= 0:
                found.setdefault((state, following), []).append(event)
    return found


def _text(x: float, y: float, text: str, anchor: str = "middle", kind: str = "event") -> str:
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" class="{kind}">{text}</text>'


def _edge(start: int, end: int, events: list[str]) -> Iterator[str]:
    """Draw one arrow: down to the next state, right for a detour, left back to the first state."""
    label, begin, arrive = ", ".join(events), TOP + STEP * start, TOP + STEP * end
    if start == end:
        yield _text(LEFT + WIDTH / 2, begin + HEIGHT - 6, f"stays: {label}")
        return
    if end == start + 1:
        x = LEFT + WIDTH / 2
        yield f'<path d="M{x} {begin + HEIGHT}V{arrive}"/>'
        yield _text(x + 6, (begin + HEIGHT + arrive) / 2 + 4, label, "start")
        return
    side = -1 if end == 0 else 1
    edge = LEFT if side < 0 else LEFT + WIDTH
    middle, bend = (begin + arrive) / 2 + HEIGHT / 2, side * (30 + 35 * abs(start - end))
    leave, reach = (begin + HEIGHT / 2 + 6 * s for s in (side, -side))
    reach += arrive - begin
    yield f'<path d="M{edge} {leave:g}C{edge + bend} {leave:g} {edge + bend} {reach:g} {edge} {reach:g}"/>'
    if end or start == len(STATES) - 1:  # all arrows to the first state have the same event
        yield _text(edge + 0.78 * bend, middle + 4, label, "start" if side > 0 else "end")


def picture() -> str:
    """Return the picture as SVG."""
    height = TOP + STEP * (len(STATES) - 1) + HEIGHT + 20
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 820 {height}" font-family="sans-serif">',
        "<style>rect,path{fill:none;stroke:#456}path{marker-end:url(#tip)}"
        ".state{font-size:14px;font-weight:bold}.event{font-size:12px;fill:#345}</style>",
        '<marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<polygon points="0,0 8,4 0,8" fill="#456"/></marker>',
    ]
    for state, name in enumerate(STATES):
        y = TOP + STEP * state
        lines.append(f'<rect x="{LEFT}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="8"/>')
        lines.append(_text(LEFT + WIDTH / 2, y + 17, name, kind="state"))
    for (start, end), events in transitions().items():
        lines += _edge(start, end, events)
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(picture())
