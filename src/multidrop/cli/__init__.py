"""The command line: runs one command. A failure becomes a sentence on stderr and an exit status.

Each command's module is imported only when the command runs. `multidrop --help` imports no such module.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from typing import Any, NoReturn

from multidrop.errors import BusError, Unsupported, WriteForbidden
from multidrop.printable import did_you_mean, nearest_names

DONE, FAILED, MISTAKE, INTERRUPTED = 0, 1, 2, 130
# Commands that continue after SIGHUP. Invalid arguments after the drive's name do not prevent them.
STOPS = ("stop", "coast", "emergency-stop")
HARD_WIRED = "use the hard-wired stop"  # advice to the user when a stop could not be sent
_MISNAMED = (FileNotFoundError, IsADirectoryError, NotADirectoryError)

COMMANDS = {  # each command's module in this package, and its help text
    "demo": ("demo", "poll simulated drives on three lines, and run their motors"),
    "schema": ("completion", "print the JSON Schema of a plant file, for editors"),
    "models": ("models", "list the families, or one family's registers"),
    "check": ("check", "check a family file or a plant file; opens no port"),
    "import": ("check", "convert another program's register table into a family file"),
    "read": ("registers", "read values from a drive"),
    "write": ("registers", "write one register of a drive"),
    "state": ("verbs", "show whether a drive runs, its direction and its fault"),
    "start": ("verbs", "start a drive's motor"),
    "stop": ("verbs", "stop a drive's motor along its deceleration ramp"),
    "coast": ("verbs", "switch a motor's voltage off and let it run out"),
    "emergency-stop": ("verbs", "stop a motor by the drive's own emergency stop"),
    "jog": ("verbs", "run a drive's motor slowly until it is stopped"),
    "reset-fault": ("verbs", "reset a drive's fault; never starts the motor"),
    "set-frequency": ("verbs", "write a drive's frequency setpoint"),
    "release-control": ("verbs", "return control of a stopped motor to its panel and terminals"),
    "ports": ("scan", "list this machine's ports, and who may open them"),
    "params": ("params", "save, compare and write the parameters of a drive"),
    "scan": ("scan", "find the drives on a line, by reading only"),
    "plan": ("plan", "predict the load of a plant file's lines; opens no port"),
    "wear": ("registers", "list the writes to EEPROMs, and how many are left"),
    "poll": ("poll", "poll the drives of a plant file, and record them"),
    "run": ("run", "run the steps of a test file, and record them"),
    "doctor": ("doctor", "examine a port and its adapter, and advise"),
    "serve": ("serve", "poll a plant for browsers and other programs"),
    "fleet": ("fleet", "share a plant's lines among several gateways, by NATS"),
    "hub": ("fleet.services", "store a fleet's samples in Parquet files or in PostgreSQL"),
    "monitor": ("monitor", "show the drives of a plant file live on a terminal"),
    "simulate": ("simulate", "simulate the drives of a plant file on pseudo-terminals"),
    "sniff": ("sniff", "listen to a line that another master polls"),
    "decode": ("sniff", "convert a capture into a recording or text"),
    "plot": ("recordings", "plot a recording's values"),
    "report": ("recordings", "summarise a recording on one HTML page"),
    "completion": ("completion", "print a script by which a shell completes commands"),
    "convert": ("recordings", "convert a recording to another format"),
}


def _listed(table: Mapping[str, tuple[str, str]]) -> str:
    return "\n".join(f"  {name:<16}{text}" for name, (_, text) in table.items())


HELP = f"""usage: multidrop COMMAND [arguments]

Poll every drive on an RS-485 line as fast as the wire allows.

{_listed(COMMANDS)}

`multidrop COMMAND --help` lists a command's arguments, `multidrop --version`
prints the version. With --json most commands print JSON for programs.
Exit status: 0 done; 1 the line or a drive failed, or a rule forbids it;
2 invalid arguments; 130 interrupted.
"""


def _help_of(prog: str, text: str, actions: Mapping[str, tuple[str, str]]) -> str:
    return f"""usage: {prog} ACTION [arguments]

{text[0].upper()}{text[1:]}.

{_listed(actions)}

`{prog} ACTION --help` lists its arguments.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    _replace_closed_streams()
    if not words or words[0] in ("-h", "--help", "--version"):
        return _guarded(partial(_describe_itself, words))
    return _guarded(partial(_run_interruptible, words))


def _run_interruptible(words: list[str]) -> int:
    from multidrop.cli.support.output import logging_to, spell_out_unencodable, warn
    from multidrop.cli.support.signals import end_signals_interrupt, outliving_the_terminal

    spell_out_unencodable()
    command = words[1] if words[0] == "fleet" and words[1:] else words[0]
    going_on = outliving_the_terminal() if command in STOPS else nullcontext()
    with end_signals_interrupt(), going_on, logging_to(warn, "multidrop.families.registry", logging.INFO):
        return _run(words[0], words[1:])


def _replace_closed_streams() -> None:
    """Open the null device for each standard stream that the caller has closed.

    Otherwise a serial port could get its descriptor, and printed text would go to the line.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode, encoding="utf-8"))


def _describe_itself(words: list[str]) -> int:
    if words[:1] == ["--version"]:
        from importlib.metadata import version

        print(f"multidrop {version('multidrop')}")
    else:
        print(HELP, end="")
    return DONE if words else MISTAKE


@contextmanager
def _without_wrappers() -> Iterator[None]:
    """If another exception has replaced a KeyboardInterrupt, raise the KeyboardInterrupt itself.

    Python replaces it in `__set_name__`, which runs when a class is created, for example during an import.
    argparse replaces it too.
    """
    try:
        yield
    except (AttributeError, RuntimeError) as failure:
        for interruption in (failure.__cause__, failure.__context__):
            if isinstance(interruption, KeyboardInterrupt):
                raise interruption from None
        raise


def _guarded(run: Callable[[], int]) -> int:
    """Run a command; print each expected failure as a sentence on stderr."""
    try:
        with _without_wrappers():
            status = run()
        sys.stdout.flush()
    except KeyboardInterrupt as interruption:  # the exception's notes list the requests that were sent
        with suppress(KeyboardInterrupt):  # the user may press Ctrl-C again immediately
            return _fail("\n".join(["interrupted", *getattr(interruption, "__notes__", ())]), INTERRUPTED)
        return INTERRUPTED
    except BrokenPipeError:  # the reader has closed the pipe, as in `multidrop models | head`
        _abandon_output()
        return DONE
    except (ValueError, TypeError, Unsupported) as mistake:
        return _fail(str(mistake), MISTAKE)
    except OSError as failure:
        if failure.strerror is None:  # raised by multidrop, not by the operating system
            lacks_library = isinstance(failure.__cause__, ImportError)
            return _fail(str(failure), MISTAKE if lacks_library else FAILED)
        _abandon_output()
        where = f"{failure.filename}: " if failure.filename else ""
        return _fail(f"{where}{failure.strerror}", MISTAKE if isinstance(failure, _MISNAMED) else FAILED)
    except BusError as failure:
        return _fail(str(failure), FAILED)
    except ImportError as missing:
        if missing.name != "nanoarrow":  # for some kinds of machines, there is no build of nanoarrow
            raise
        return _fail(str(missing), MISTAKE)
    return status


def _found(kind: str, name: str, table: Mapping[str, tuple[str, str]], prog: str) -> tuple[str, str]:
    if name not in table:
        hint = did_you_mean(name, table, f"see `{prog} --help`", 1)
        raise ValueError(f"there is no {kind} {name!r}; {hint}")
    return table[name]


def _run(command: str, words: list[str]) -> int:
    prog = f"multidrop {command}"
    name, text = _found("command", command, COMMANDS, "multidrop")
    module: Any = importlib.import_module(f"multidrop.cli.{name}")
    if hasattr(module, "ACTIONS"):
        if not words or words[0] in ("-h", "--help"):
            print(_help_of(prog, text, module.ACTIONS), end="")
            return DONE if words else MISTAKE
        command, *words = words
        name, text = _found("action", command, module.ACTIONS, prog)
        module = importlib.import_module(f"{module.__name__}.{name}") if name else module
        prog = f"{prog} {command}"
    parser = _Parser(prog=prog, description=text[0].upper() + text[1:] + ".", allow_abbrev=False)
    parser.set_defaults(command=command)
    module.add_arguments(parser)
    try:
        arguments, left_out = _parsed(parser, words, command)
    except SystemExit:  # raised by argparse, which prints --help and then exits
        return DONE
    except ValueError as mistake:
        if command in STOPS:
            raise ValueError(f"the {command} was NOT sent: {mistake}") from None
        raise
    if left_out:
        _fail(f"{command}: ignored unknown options: {' '.join(left_out)}", MISTAKE)
    try:
        return int(module.run(arguments)) or (MISTAKE if left_out else DONE)
    except WriteForbidden as refusal:
        from multidrop.cli.support.arguments import is_plant

        in_plant = any(is_plant(first) for first in getattr(arguments, "words", [])[:1])
        return _fail(refusal.for_command_line(in_plant=in_plant), FAILED)


class _Parser(argparse.ArgumentParser):
    """An argument parser that raises ValueError for invalid arguments instead of exiting."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see `{self.prog} --help`")


def _option_hint(parser: argparse.ArgumentParser, word: str) -> str:
    known = [option for action in parser._actions for option in action.option_strings]
    near = nearest_names(word.partition("=")[0], known, 1) if word.startswith("--") else []
    return f"; did you mean {near[0]}?" if near else ""


def _parsed(
    parser: argparse.ArgumentParser, words: list[str], command: str
) -> tuple[argparse.Namespace, list[str]]:
    """Return the parsed arguments, and the words that a stop ignores. Raises ValueError for an invalid word.

    A stop ignores unknown options. It also ignores the word after such an option, because that may be the
    option's value instead of a drive.
    """
    # a user may write options between the other words
    arguments, unknown = parser.parse_known_intermixed_args(words)
    if not unknown:
        return arguments, []
    if command not in STOPS:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{_option_hint(parser, unknown[0])}")
    options = [word for word in unknown if word.startswith("-")]
    kept: list[str] = []
    left_out: list[str] = []
    for before, word in zip(["", *words[:-1]], words, strict=True):
        is_value = before in options and "=" not in before and not word.startswith("-")
        (left_out if is_value or word in options else kept).append(word)
    arguments, surplus = parser.parse_known_intermixed_args(kept)
    return arguments, [*left_out, *surplus]


def _fail(sentences: str, status: int) -> int:
    from multidrop.cli.support.output import warn

    warn(sentences)
    return status


def _abandon_output() -> None:
    """Redirect stdout to /dev/null, because the interpreter would fail to flush it at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
