"""Fuzz a reader of readers.py, guided by coverage: `guided.py READER CORPUS... [libFuzzer's options]`. Needs
atheris (libFuzzer for Python).
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
import tempfile
import tomllib._parser
import types
from functools import partial
from pathlib import Path

import atheris
from readers import read

import multidrop.capture
import multidrop.families.files
import multidrop.families.registry
import multidrop.gateway.modbus_server.protocol
import multidrop.gateway.modbus_server.server
import multidrop.importers
import multidrop.plant.model
import multidrop.recording
import multidrop.samples.message
import multidrop.sim.faults
import multidrop.toml_check
from multidrop.capture import decoding

PACKAGES: dict[str, tuple[types.ModuleType, ...]] = {  # reader: modules whose coverage is measured
    "plant": (multidrop.families.files,),
    "family": (multidrop.families.files,),
    "import": (multidrop.families.files, multidrop.importers),
    "arrows": (multidrop.recording,),
    "csv": (multidrop.recording,),
    "parquet": (multidrop.recording,),
    "pcap": (multidrop.capture,),
}
MODULES = (  # modules whose coverage is measured for every reader
    multidrop.plant.model,
    multidrop.toml_check,
    multidrop.families.registry,
    multidrop.sim.faults,
    multidrop.samples.message,
    multidrop.gateway.modbus_server.protocol,
    multidrop.gateway.modbus_server.server,
    tomllib._parser,
)


def instrument(module: types.ModuleType) -> None:
    """Make the coverage of this module's functions visible to the fuzzer."""
    owners = [module, *(each for each in vars(module).values() if isinstance(each, type))]
    for owner in owners:
        for function in list(vars(owner).values()):
            if isinstance(function, types.FunctionType) and function.__module__ == module.__name__:
                atheris.instrument_func(function)


def main() -> None:
    name, *arguments = sys.argv[1:]
    decoding.ROWS = 2048  # rows per batch: fewer than usual, but enough for a read of 2000 coils
    for package in PACKAGES.get(name, ()):
        for found in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
            instrument(importlib.import_module(found.name))
    for module in MODULES:
        instrument(module)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        one = partial(read, name, folder=Path(folder))
        again = f"{sys.executable} {__file__} {name}"  # libFuzzer starts itself by this command for a merge
        atheris.Setup([again, *arguments], lambda data: one(data))
        atheris.Fuzz()


if __name__ == "__main__":
    main()
