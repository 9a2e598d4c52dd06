"""The state that `multidrop fleet status` prints, for tests that wait for a state."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from contextlib import redirect_stdout
from io import StringIO
from typing import Any
from unittest.mock import patch

from multidrop.cli import main

LOOK_S = 0.25  # between queries, each of which costs as much CPU as seconds of a gateway


def fleet_status(environment: Mapping[str, str]) -> dict[str, Any]:
    """Return the present state of a fleet, or an empty one if its servers give none, as during an election.

    The query runs in this process, because tests repeat it often.
    """
    time.sleep(LOOK_S)
    with patch.dict(os.environ, environment), redirect_stdout(StringIO()) as out:
        status = main(["fleet", "status", "--json"])
    if status and not out.getvalue():
        return {"gateways": {}, "lines": {}}
    found: dict[str, Any] = json.loads(out.getvalue())
    silent = {name for name, gateway in found["gateways"].items() if gateway["says"] is None}
    lost = any(gateway["says"]["lost"] for gateway in found["gateways"].values() if gateway["says"])
    is_unpolled = any(line["master"] in {None, *silent} for line in found["lines"].values())
    assert status == int(is_unpolled or lost or bool(found["missing"]))
    return found
