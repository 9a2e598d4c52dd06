"""What a line should reach, as its recording carries it: so that a reader can hold it against what was."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from multidrop.core import build_request, reply_length
from multidrop.planning.blocks import Planned
from multidrop.planning.bus_time import silence
from multidrop.planning.prediction import predict


def forecast(exchanges: Sequence[Planned], switching: float = 0.0) -> dict[str, Any]:
    """The prediction for a line, and of each drive's blocks what they take of it: by plain numbers.

    Characters are those on the wire; of a reply, of a good one.
    """
    prediction = predict(exchanges, switching=switching)
    drives = dict.fromkeys(it.drive for it in exchanges)
    return {
        "utilisation": round(prediction.utilisation, 4),
        "cycle_ms": round(prediction.cycle * 1e3, 3),
        "drives": {
            drive.name: {
                "exchanges_per_second": round(prediction.exchanges_per_second(drive), 3),
                "silence_ms": round(silence(drive) * 1e3, 6),
                "character_ms": round(drive.settings.character * 1e3, 6),
                "response_delay_ms": drive.response_delay * 1e3,
                "blocks": [_block(it) for it in exchanges if it.drive is drive],
            }
            for drive in drives
        },
    }


def _block(planned: Planned) -> dict[str, Any]:
    drive = planned.drive
    request = planned.block.request(drive.address)
    return {
        "registers": [it.name for it in planned.block.registers],
        "every_ms": None if planned.every is None else planned.every * 1e3,
        "request_characters": len(build_request(drive.framing, request)),
        "reply_characters": reply_length(drive.framing, request),
    }
