"""Values per second, and CPU time per value, for decoding replies into batches and writing them to disk.

The same 16 replies of 10 registers are decoded again for every batch.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.masters import adapter
from bench.support import tables


def cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--values", type=int, default=20_000_000)
    parser.add_argument("--slices", type=int, default=5)
    parser.add_argument("--suffixes", nargs="+", default=[".arrows"])
    parser.add_argument("--out", type=Path, help="directory to write in; a temporary one")
    arguments = parser.parse_args()
    tables.heading(f"{arguments.values} values decoded and recorded, {arguments.slices} times.")

    decode = adapter.decoder(drives=16)
    rows = []
    with TemporaryDirectory(dir=arguments.out) as directory:
        for suffix in arguments.suffixes:
            for _ in range(arguments.slices):
                path = Path(directory) / f"recording{suffix}"
                cpu, begun = cpu_seconds(), time.monotonic()
                values = adapter.record(path, decode, arguments.values)
                seconds, cpu = time.monotonic() - begun, cpu_seconds() - cpu
                size = path.stat().st_size
                rate, each = f"{values / seconds / 1e6:.2f}", f"{cpu / values * 1e9:.0f}"
                rows.append((suffix, values, rate, each, f"{size / values:.1f}"))
                path.unlink()
    tables.show(("format", "values", "million/s", "CPU ns/value", "bytes/value"), rows)


if __name__ == "__main__":
    main()
