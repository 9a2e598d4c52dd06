"""The command line: finds the command, runs it, and turns what goes wrong into a sentence and a status.

A command's module is imported when it is run: `multidrop --help` loads none of them.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import logging
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from multidrop.errors import BusError, Refused, Unsupported
from multidrop.printable import printable

DONE, FAILED, MISTAKE, INTERRUPTED = 0, 1, 2, 130
_MISNAMED = (FileNotFoundError, IsADirectoryError, NotADirectoryError)

COMMANDS = {  # name: its module here, and what it does
    "demo": ("demo", "poll simulated drives of every family on one line"),
    "models": ("models", "list the families, or one family's registers"),
    "read": ("read", "read values from a drive"),
    "write": ("write", "write one register of a drive"),
    "state": ("verbs", "say whether a drive runs, which way, and its fault"),
    "start": ("verbs", "start a drive's motor"),
    "stop": ("verbs", "stop it along its deceleration ramp"),
    "coast": ("verbs", "take the voltage off and let it run out"),
    "emergency-stop": ("verbs", "stop it as the drive's own emergency stop does"),
    "jog": ("verbs", "turn it slowly until stopped"),
    "reset-fault": ("verbs", "reset a drive's fault; never starts the motor"),
    "set-frequency": ("verbs", "write a drive's frequency setpoint"),
    "scan": ("scan", "find the drives on a line, by reading only"),
    "plan": ("plan", "predict what a plant file's lines will reach; opens no port"),
    "wear": ("wear", "list what was written to EEPROMs, and what is left"),
    "poll": ("poll", "poll the drives of a plant file, and record them"),
    "doctor": ("doctor", "say what is amiss with a port and its adapter"),
    "monitor": ("monitor", "show the drives of a plant file live on a terminal"),
    "simulate": ("simulate", "play the drives of a plant file on pseudo-terminals"),
    "sniff": ("sniff", "listen to a line that someone else masters"),
    "decode": ("decode", "turn a capture into a recording or into text"),
    "plot": ("plot", "draw a recording's values into a picture"),
    "report": ("report", "write one page of all that a recording tells"),
    "convert": ("convert", "turn one recording into another format"),
}

_LIST = "\n".join(f"  {name:<16}{text}" for name, (_, text) in COMMANDS.items())
HELP = f"""usage: multidrop COMMAND [arguments]

Poll every drive on an RS-485 line as fast as the wire allows.

{_LIST}

`multidrop COMMAND --help` says what a command takes; --json prints for programs.
Exit status: 0 done, 1 the line or a drive failed or a rule forbade it, 2 mistaken call.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; its exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        print(HELP, end="")
        return DONE if words else MISTAKE
    if words[0] == "--version":
        from importlib.metadata import version

        print(f"multidrop {version('multidrop')}")
        return DONE
    with _sigterm_as_interrupt(), _telling_what_is_run():
        return _guarded(words[0], words[1:])


def _guarded(command: str, words: list[str]) -> int:
    """Run it; every foreseeable failure becomes a sentence on stderr."""
    try:
        status = _run(command, words)
        if sys.stdout is not None:  # as it is where the caller has closed it
            sys.stdout.flush()
    except KeyboardInterrupt as interruption:  # its notes say what was sent
        return _say("\n".join(["interrupted", *getattr(interruption, "__notes__", ())]), INTERRUPTED)
    except BrokenPipeError:  # whoever reads our output has seen enough
        _abandon_output()
        return DONE
    except Refused as refusal:
        return _say(refusal.for_command_line(), FAILED)
    except (ValueError, TypeError, Unsupported) as mistake:
        return _say(str(mistake), MISTAKE)
    except OSError as failure:
        if failure.strerror is None:  # one of ours
            return _say(str(failure), FAILED)
        _abandon_output()
        where = f"{failure.filename}: " if failure.filename else ""
        return _say(f"{where}{failure.strerror}", MISTAKE if isinstance(failure, _MISNAMED) else FAILED)
    except BusError as failure:
        return _say(str(failure), FAILED)
    return status


def _run(command: str, words: list[str]) -> int:
    if command not in COMMANDS:
        near = difflib.get_close_matches(command, COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else "see `multidrop --help`"
        raise ValueError(f"there is no command {command!r}; {hint}")
    name, text = COMMANDS[command]
    module: Any = importlib.import_module(f"multidrop.cli.{name}")
    parser = _Parser(prog=f"multidrop {command}", description=text.capitalize() + ".", allow_abbrev=False)
    parser.set_defaults(command=command)
    module.add_arguments(parser)
    try:
        arguments = parser.parse_intermixed_args(words)  # an option may stand between positionals
    except SystemExit:  # --help was printed
        return DONE
    return int(module.run(arguments))


class _Parser(argparse.ArgumentParser):
    """Mistakes in the arguments are a ValueError, as all mistakes are."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see `{self.prog} --help`")


def _say(sentences: str, status: int) -> int:
    for sentence in sentences.splitlines():
        print(f"multidrop: {printable(sentence)}", file=sys.stderr)
    return status


def _abandon_output() -> None:
    """Nothing more can be written to stdout: keep the interpreter from trying when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _OnStderr(logging.Handler):
    """Says what is logged as all else is said."""

    def emit(self, record: logging.LogRecord) -> None:
        _say(record.getMessage(), DONE)


@contextmanager
def _telling_what_is_run() -> Iterator[None]:
    """Say which files with models of the user's own are run, which they are for every command."""
    logger, handler = logging.getLogger("multidrop.drives.registry"), _OnStderr()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


@contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    """SIGTERM ends a command as Ctrl-C does."""
    try:
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    except ValueError:  # not the main thread, whose business signals are
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
