"""A recording as one HTML page that needs nothing else: tables, and pictures inside it."""

from __future__ import annotations

import base64
import html
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

from matplotlib.figure import Figure

from multidrop.printable import printable
from multidrop.report.health import DelaySeries, delays, draw_delays, draw_miss_shares, draw_rates, reasons_of
from multidrop.report.load import Selection
from multidrop.report.style import png
from multidrop.report.utilisation import Used, draw_used, used
from multidrop.report.value_plot import FAULTS, plot

SHORT = 32  # characters, in a cell that is not broken

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; }
body { max-width: 1100px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; }
h2 { font-size: 1.15em; margin: 2em 0 .4em; border-bottom: 1px solid #ddd; }
p.about { color: #555; margin-top: .2em; }
table { border-collapse: collapse; }
th, td { padding: .2em .9em .2em 0; text-align: left; vertical-align: top; border-bottom: 1px solid #eee; }
th { font-weight: 600; color: #555; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td.short { white-space: nowrap; }
img { width: 100%; height: auto; }
div.wide { overflow-x: auto; }
"""


def plot_page(look: Selection, figure: Figure) -> str:
    """The picture of values, as a page."""
    return _page(f"{look.path.name}", [_about(look), _image(figure, "values over time")])


def report_page(look: Selection) -> str:
    """All that the recording tells of itself."""
    parts = [_about(look), *_drives(look), *_used(used(look), look), "<h2>Rates and misses</h2>"]
    parts += [_image(draw_rates(look), "values and misses a second"), *_misses(look)]
    shares = draw_miss_shares(look)
    if shares:
        text = "Noise that comes with the motor's speed shows as a slope to the right."
        parts += [
            "<h2>Misses against output frequency</h2>",
            f"<p>{text}</p>",
            _image(shares, "misses against output frequency"),
        ]
    parts += [*_delays(delays(look)), *_faults(look), "<h2>Values</h2>", *_values(look)]
    return _page(f"Report on {look.path.name}", parts)


def _page(title: str, parts: Sequence[str]) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_escape(title)}</title><style>{_STYLE}</style></head><body>\n"
        f"<h1>{_escape(title)}</h1>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _about(look: Selection) -> str:
    begin = datetime.fromtimestamp(look.begin / 1e9, UTC)
    plant = look.metadata.get("plant")
    values = sum(int((~it.missed).sum()) for it in look.series)
    misses = sum(int(it.missed.sum()) for it in look.series)
    text = (
        f"From {begin:%Y-%m-%d %H:%M:%S} UTC, {_duration(look.seconds)}; "
        f"{_count(len(look.drives), 'drive')}; {_count(values, 'value')}, {_count(misses, 'miss', 'misses')}"
    )
    of_plant = _escape(f"; plant {plant}") if plant else ""
    return f'<p class="about">{text}{of_plant}</p>'


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}".replace(",", "\u202f")


def _duration(seconds: float) -> str:
    hours, rest = divmod(round(seconds), 3600)
    minutes, rest = divmod(rest, 60)
    if hours:
        return f"{hours} h {minutes:02} min"
    return f"{minutes} min {rest:02} s" if minutes else f"{seconds:.1f} s"


def _drives(look: Selection) -> Iterator[str]:
    yield "<h2>What was polled</h2>"
    rows = []
    for drive in look.drives:
        about = look.about(drive)
        series = look.of(drive)
        values = sum(int((~it.missed).sum()) for it in series)
        misses = sum(int(it.missed.sum()) for it in series)
        rows.append(
            [
                drive,
                str(about.get("line", "")),
                str(about.get("model", "")),
                str(about.get("address", "")),
                f"{about.get('settings', '')} {about.get('framing', '')}",
                ", ".join(it.register for it in series),
                f"{values / max(look.seconds, 1e-9):.1f}",
                str(values),
                str(misses),
                f"{misses / max(values + misses, 1):.2%}",
            ]
        )
    heads = ["Drive", "Line", "Model", "Address", "Settings", "Registers"]
    yield _table([*heads, "#Values/s", "#Values", "#Misses", "#Missed"], rows)


def _used(found: Sequence[Used], look: Selection) -> Iterator[str]:
    yield "<h2>Utilisation against plan</h2>"
    if not found:
        yield "<p>The recording does not carry a plan: it was not made by polling a plant file.</p>"
        return
    yield (
        "<p>What the answered exchanges had to take of the line: silence, request, response delay and "
        "reply. What else was sent meanwhile, such as commands, is not recorded. The plan reckons with "
        "the response delays that the drives' documents state.</p>"
    )
    yield _image(draw_used(found, look), "utilisation over time")
    rows = []
    for it in found:
        planned = it.planned
        cycle = "" if it.cycle is None else f"{it.cycle * 1e3:.1f}"
        rows.append([it.line, "utilisation, %", _percent(planned["utilisation"]), _percent(it.utilisation)])
        if cycle:
            rows.append(["", "bus cycle, ms", f"{planned['cycle_ms']:.1f}", cycle])
        rows += [
            ["", f"{name}, exchanges/s", f"{drive['exchanges_per_second']:.1f}", f"{it.rate(name):.1f}"]
            for name, drive in planned["drives"].items()
        ]
    yield _table(["Line", "What", "#Planned", "#Measured"], rows)


def _percent(part: float) -> str:
    return f"{part * 100:.1f}"


def _misses(look: Selection) -> Iterator[str]:
    by_drive = {drive: reasons_of(look, drive) for drive in look.drives}
    reasons = sum(by_drive.values(), Counter())
    if not reasons:
        return
    order = [reason for reason, _ in reasons.most_common()]
    rows = [
        [drive, *(str(counts[reason] or "") for reason in order), str(counts.total())]
        for drive, counts in by_drive.items()
    ]
    yield _table(["Drive", *(f"#{reason}" for reason in order), "#All misses"], rows)


def _delays(found: Sequence[DelaySeries]) -> Iterator[str]:
    yield "<h2>Response delays</h2>"
    if not found:
        yield "<p>No drive ever answered.</p>"
        return
    yield "<p>From the request's last bit to the reply's first. A value was taken within this time.</p>"
    yield _image(draw_delays(found), "response delays by drive")
    parts = {"least": 0.0, "median": 0.5, "95 %": 0.95, "99 %": 0.99, "longest": 1.0}
    rows = [
        [
            it.drive + ("" if it.exact else " (with the request)"),
            str(len(it.seconds)),
            *(f"{it.quantile(part) * 1e3:.1f}" for part in parts.values()),
        ]
        for it in found
    ]
    yield _table(["Drive", "#Replies", *(f"#{name}, ms" for name in parts)], rows)


def _faults(look: Selection) -> Iterator[str]:
    yield "<h2>Faults</h2>"
    series = [it for it in look.series if it.register == FAULTS]
    rows = [
        [
            it.drive,
            span.what,
            f"{datetime.fromtimestamp(span.begin / 1e9, UTC):%Y-%m-%d %H:%M:%S}",
            _duration((span.end - span.begin) / 1e9),
        ]
        for it in series
        for span in it.faults()
    ]
    if rows:
        yield _table(["Drive", "Fault", "From, UTC", "#For"], rows)
    elif series:
        yield "<p>None was seen.</p>"
    else:
        yield "<p>No register called fault was polled.</p>"


def _values(look: Selection) -> Iterator[str]:
    if not any(it.has_values for it in look.series):
        yield "<p>There is none.</p>"
        return
    figure, left = plot(look)
    if left:
        names = _escape("; ".join(left))
        yield f"<p>Not shown: {names}. <code>multidrop plot --register NAME</code> shows each.</p>"
    yield _image(figure, "values over time")


def _escape(text: str) -> str:
    return html.escape(printable(text))


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A column whose head begins with # has numbers, which stand to the right."""
    kinds = [f' class="{_kind(column)}"' for column in zip(heads, *rows, strict=True)]
    head = "".join(
        f"<th{kind}>{_escape(text.removeprefix('#'))}</th>" for kind, text in zip(kinds, heads, strict=True)
    )
    body = "\n".join(
        "<tr>"
        + "".join(f"<td{kind}>{_escape(cell)}</td>" for kind, cell in zip(kinds, row, strict=True))
        + "</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>\n{body}</table></div>'


def _kind(column: Sequence[str]) -> str:
    if column[0].startswith("#"):
        return "number"
    return "short" if max(map(len, column)) <= SHORT else "long"


def _image(figure: Figure, what: str) -> str:
    data = base64.b64encode(png(figure)).decode()
    return f'<img alt="{_escape(what)}" src="data:image/png;base64,{data}">'
