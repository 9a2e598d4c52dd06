"""Fill a spool until killed: `python spool_filler.py FOLDER FIRST`.

Each output line is the number of exchanges, from FIRST on, that are stored.
"""

from __future__ import annotations

import sys
import time
from itertools import count
from pathlib import Path

from spooled import numbered

from multidrop.fleet.samples.spool import Spool

EXCHANGES = 20  # per batch


def main(folder: Path, first: int) -> None:
    spool = Spool(folder, "gateway-1")
    print(0, flush=True)
    for number in count(1):
        spool.append(numbered(first + (number - 1) * EXCHANGES, EXCHANGES))
        if number % 3 == 0 and spool.sync(60.0):
            print(number * EXCHANGES, flush=True)
            time.sleep(0.001)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
