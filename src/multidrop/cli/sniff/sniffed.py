"""What was sniffed on lines, printed as it comes, counted, and written into a capture."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable, Mapping

from multidrop.capture import Capture, CaptureWriter, Pairing, Side, Sniffed
from multidrop.capture.lookup import RegisterLookup, line_of
from multidrop.capture.text import ExchangeFormatter
from multidrop.cli.support.saying import say
from multidrop.core import FrameSpan, Kind, Splitter, Stream
from multidrop.plant.model import Plant, PlantLine

_SIDES = {
    Kind.JUNK: Side.EITHER,
    Kind.REQUEST: Side.ASKING,
    Kind.EITHER: Side.ASKING,
    Kind.REPLY: Side.ANSWERING,
    Kind.STRAY: Side.ANSWERING,
}


class Ear:
    """One line that is listened to."""

    def __init__(
        self, name: str, line: PlantLine | None, *, as_json: bool, out: CaptureWriter | None
    ) -> None:
        self.name = name
        self.pairing = Pairing()
        self._splitter = Splitter()
        self._formatter = ExchangeFormatter(RegisterLookup(line))
        self._as_json = as_json
        self._out = out

    def hear(self, stream: Stream) -> None:
        """Print what came of it so far."""
        spans = list(self._splitter.spans(stream))
        if self._out:
            self._write(spans, self._out)
        self._print(self.pairing.pair(spans))

    def rest(self) -> None:
        """Nothing more is to be waited for."""
        self._print(self.pairing.flush())

    def _write(self, spans: list[FrameSpan], out: CaptureWriter) -> None:
        for span in spans:
            out.write(span.raw, _SIDES[span.kind], span.time_ns, self.name)

    def _print(self, told: Iterable[Sniffed]) -> None:
        for it in told:
            if self._as_json:
                say(json.dumps({"line": self.name} | self._formatter.json(it)))
            else:
                say(self._formatter.text(it))
        sys.stdout.flush()


def replay(
    capture: Capture, plant: Plant | None, *, as_json: bool, out: CaptureWriter | None = None
) -> Counter[str]:
    """Print all that a capture holds, as if it came now; how much of what that was."""
    ears: list[Ear] = []
    for _ in capture:
        ears += [
            Ear(name, line_of(plant, name), as_json=as_json, out=out) for name in capture.lines[len(ears) :]
        ]
        for ear, stream in zip(ears, capture.streams, strict=True):
            ear.hear(stream)
    for ear in ears:
        ear.rest()
    return sum((Counter(ear.pairing.counts()) for ear in ears), Counter())


_COUNTED = {  # one, many
    "exchanges": ("exchange", "exchanges"),
    "broadcasts": ("broadcast", "broadcasts"),
    "unanswered": ("request without a reply", "requests without a reply"),
    "strays": ("reply without a request", "replies without a request"),
    "unknown_bytes": ("unknown byte", "unknown bytes"),
}
_ALWAYS = ("exchanges", "unknown_bytes")


def summary(counts: Mapping[str, int]) -> str:
    """How much was stream, in words."""
    return ", ".join(
        f"{counts.get(name, 0)} {words[counts.get(name, 0) != 1]}"
        for name, words in _COUNTED.items()
        if counts.get(name) or name in _ALWAYS
    )
