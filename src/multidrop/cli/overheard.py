"""What was overheard on lines, printed as it comes, counted, and written into a capture."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable, Mapping

from multidrop.capture import Capture, CaptureWriter, Overheard, Pairing, Side
from multidrop.capture.meaning import Meanings, line_of
from multidrop.capture.text import Teller
from multidrop.cli.saying import say
from multidrop.core import Heard, Kind, Span, Splitter
from multidrop.plant import Line, Plant

_SIDES = {
    Kind.JUNK: Side.EITHER,
    Kind.REQUEST: Side.ASKING,
    Kind.EITHER: Side.ASKING,
    Kind.REPLY: Side.ANSWERING,
    Kind.STRAY: Side.ANSWERING,
}


class Ear:
    """One line that is listened to."""

    def __init__(self, name: str, line: Line | None, *, as_json: bool, out: CaptureWriter | None) -> None:
        self.name = name
        self.pairing = Pairing()
        self._splitter = Splitter()
        self._teller = Teller(Meanings(line))
        self._as_json = as_json
        self._out = out

    def hear(self, heard: Heard) -> None:
        """Print what came of it so far."""
        spans = list(self._splitter.spans(heard))
        if self._out:
            self._write(spans, self._out)
        self._print(self.pairing.pair(spans))

    def rest(self) -> None:
        """Nothing more is to be waited for."""
        self._print(self.pairing.rest())

    def _write(self, spans: list[Span], out: CaptureWriter) -> None:
        for span in spans:
            out.write(span.raw, _SIDES[span.kind], span.time_ns, self.name)

    def _print(self, told: Iterable[Overheard]) -> None:
        for it in told:
            if self._as_json:
                say(json.dumps({"line": self.name} | self._teller.json(it)))
            else:
                say(self._teller.text(it))
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
        for ear, heard in zip(ears, capture.heard, strict=True):
            ear.hear(heard)
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
    """How much was heard, in words."""
    return ", ".join(
        f"{counts.get(name, 0)} {words[counts.get(name, 0) != 1]}"
        for name, words in _COUNTED.items()
        if counts.get(name) or name in _ALWAYS
    )
