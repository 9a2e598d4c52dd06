"""Traffic of sniffed lines: printed as it comes, counted, and written into a capture."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable, Mapping

from multidrop.capture import Capture, CaptureWriter, Pairing, Side, Sniffed
from multidrop.capture.lookup import RegisterLookup, line_of
from multidrop.capture.text import ExchangeFormatter
from multidrop.cli.support.output import print_text
from multidrop.core import FrameSpan, Kind, Splitter, Stream
from multidrop.plant.model import Plant, PlantLine

_SIDES = {
    Kind.JUNK: Side.EITHER,
    Kind.REQUEST: Side.ASKING,
    Kind.EITHER: Side.ASKING,
    Kind.REPLY: Side.ANSWERING,
    Kind.STRAY: Side.ANSWERING,
}


class TrafficPrinter:
    """Prints the exchanges of one line."""

    def __init__(
        self, name: str, line: PlantLine | None, *, as_json: bool, out: CaptureWriter | None
    ) -> None:
        self.name = name
        self.pairing = Pairing()
        self._splitter = Splitter()
        self._formatter = ExchangeFormatter(RegisterLookup(line))
        self._as_json = as_json
        self._out = out

    def show(self, stream: Stream) -> None:
        """Print what is complete in the stream so far."""
        spans = list(self._splitter.spans(stream))
        if self._out:
            self._write(spans, self._out)
        self._print(self.pairing.pair(spans))

    def finish(self) -> None:
        """Print the requests that still wait for a reply: none will come."""
        self._print(self.pairing.flush())

    def _write(self, spans: list[FrameSpan], out: CaptureWriter) -> None:
        for span in spans:
            out.write(span.raw, _SIDES[span.kind], span.time_ns, self.name)

    def _print(self, traffic: Iterable[Sniffed]) -> None:
        for sniffed in traffic:
            if self._as_json:
                print_text(json.dumps({"line": self.name} | self._formatter.json(sniffed)))
            else:
                print_text(self._formatter.text(sniffed))
        sys.stdout.flush()


def replay(
    capture: Capture, plant: Plant | None, *, as_json: bool, out: CaptureWriter | None = None
) -> Counter[str]:
    """Print all that a capture holds; return its counts, as `summary` takes them."""
    printers: list[TrafficPrinter] = []
    for _ in capture:
        printers += [
            TrafficPrinter(name, line_of(plant, name), as_json=as_json, out=out)
            for name in capture.lines[len(printers) :]
        ]
        for printer, stream in zip(printers, capture.streams, strict=True):
            printer.show(stream)
    for printer in printers:
        printer.finish()
    return sum((Counter(printer.pairing.counts()) for printer in printers), Counter())


_COUNTED = {  # one, many
    "exchanges": ("exchange", "exchanges"),
    "broadcasts": ("broadcast", "broadcasts"),
    "unanswered": ("request without a reply", "requests without a reply"),
    "strays": ("reply without a request", "replies without a request"),
    "unknown_bytes": ("unknown byte", "unknown bytes"),
}
_ALWAYS = ("exchanges", "unknown_bytes")


def summary(counts: Mapping[str, int]) -> str:
    """Return the counts in words."""
    return ", ".join(
        f"{counts.get(name, 0)} {words[counts.get(name, 0) != 1]}"
        for name, words in _COUNTED.items()
        if counts.get(name) or name in _ALWAYS
    )
