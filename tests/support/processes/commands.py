"""Run `multidrop` commands as users do, in separate processes; kill processes; find leaked resources."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, Any, AnyStr

from multidrop.families.registry import find_model

MULTIDROP = [sys.executable, "-m", "multidrop"]
TOY = f"{Path(__file__).parents[1]}/drives/toy.py:Toy"
find_model(TOY)  # loads the file before a test: loading makes a log entry
Run = Callable[..., tuple[int, str, str]]
TOY_IS_RUN = f"multidrop: {TOY.rpartition(':')[0]} is run as Python: a user's model is a program\n"


class BoundProcess(subprocess.Popen[AnyStr]):
    """A process that is killed if its `with` block fails, whereas `Popen` would wait for its end."""

    def __exit__(
        self, kind: type[BaseException] | None, failure: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if failure is not None:
            self.kill()
        super().__exit__(kind, failure, traceback)


def multidrop(*words: object, most_bytes: int | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; with `most_bytes`, files are limited to this size, like on a full disk."""

    def limit() -> None:
        import resource  # imported here: Windows has no such module

        assert most_bytes is not None
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    done = subprocess.run(
        [*MULTIDROP, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=180,
        preexec_fn=None if most_bytes is None else limit,
    )
    done.stderr = done.stderr.replace(TOY_IS_RUN, "", 1)
    return done


@contextmanager
def running(*words: object) -> Iterator[tuple[subprocess.Popen[str], IO[str]]]:
    """Start a command; yield its process and its output stream."""
    with BoundProcess([*MULTIDROP, *map(str, words)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process, process.stdout
        process.kill()


def plant_file(directory: Path, *, dead: bool = False) -> Path:
    """Write a plant file with one simulated drive and, if `dead`, a second drive that never replies."""
    line = f'[[line]]\nname = "hall-1"\nport = "{directory}/ports/hall-1"\n'
    drive = '[[line.drive]]\nname = "{}"\nmodel = "{}"\naddress = {}\n'
    path = directory / f"{'with-dead' if dead else 'living'}.toml"
    path.write_text(line + drive.format("pump-1", TOY, 1) + (drive.format("pump-9", TOY, 9) if dead else ""))
    return path


# ---- killing and counting ----


def kill_all(processes: Iterable[subprocess.Popen[Any]]) -> None:
    """Kill processes, even suspended ones, and wait for their end."""
    killed = list(processes)
    for process in killed:
        process.kill()
    for process in killed:
        process.wait()


def descriptors() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def threads() -> int:
    """Return the number of threads, except the logging thread, which starts at the first log entry."""
    return sum(thread.name != "multidrop log" for thread in threading.enumerate())
