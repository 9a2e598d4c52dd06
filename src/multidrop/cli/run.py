"""`multidrop run`: carries out the steps of a test file, shows its progress, and records it."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from multidrop.cli import DONE, FAILED
from multidrop.cli.poll import LiveTable
from multidrop.cli.support.arguments import (
    add_json_argument,
    add_port_option,
    add_speed_option,
    add_writing_arguments,
    ports_of,
)
from multidrop.cli.support.files import refuse_overwriting
from multidrop.cli.support.output import confirm, print_json, print_text, warn
from multidrop.cli.support.values import aligned, counted
from multidrop.cli.verbs import stop_sentence
from multidrop.control.exit_hook import signal_has_come
from multidrop.drive.known_state import can_show_fault
from multidrop.polling.batch import Rows
from multidrop.recording import FORMATS
from multidrop.runs import RunResult, TestRun
from multidrop.runs.checks import silence_of
from multidrop.runs.loader import STOP
from multidrop.runs.model import length, polled_drive

STOPPING = "stopping all drives"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "test", metavar="TEST.toml", type=Path, help="the phases with their steps, and limits"
    )
    add_port_option(parser)
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help=f"record into this new file: {', '.join(FORMATS)}"
    )
    parser.add_argument("--dry-run", action="store_true", help="show the planned times; open no port")
    parser.add_argument("--simulate", action="store_true", help="run it with simulated drives")
    add_speed_option(parser, "with --simulate: let all times pass N times as fast")
    add_writing_arguments(parser)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.speed != 1.0 and not arguments.simulate:
        raise ValueError("--speed is the pace of simulated time: add --simulate, or remove --speed")
    if arguments.simulate and arguments.ports:
        raise ValueError("--simulate opens its own ports: remove --port")
    if arguments.out:
        refuse_overwriting(arguments.out)
    test = TestRun(arguments.test, audit=arguments.audit, speed=arguments.speed)
    if arguments.dry_run:
        return _show(test, arguments)
    with ExitStack() as stack:
        ports = ports_of(arguments)
        if arguments.simulate:
            from multidrop.cli.simulate import simulator  # imports the simulator

            folder = Path(stack.enter_context(TemporaryDirectory(prefix="multidrop-")))
            ports = stack.enter_context(simulator(test.plan.plant.path, folder, speed=arguments.speed))
        else:
            _confirm(test, arguments)
        test = TestRun(
            test.plan.with_plant(test.plan.plant.with_ports(ports)),
            audit=arguments.audit,
            speed=arguments.speed,
        )
        takers = stack.enter_context(_screen(test, arguments))
        return _conclude(test.run(arguments.out, *takers), arguments)


def _confirm(test: TestRun, arguments: argparse.Namespace) -> None:
    """Print what each motor does if this computer fails, then ask. Raises WriteForbidden unless confirmed."""
    drives = [test.plan.plant.find_drive(name)[1] for name in test.plan.commanded]
    for drive in drives:
        warn(f"{drive.name}, if this computer or its power fails: {drive.watchdog}")
    for sentence in _unseen_faults(test).values():
        warn(sentence)
    known: set[str] = set()
    for step in test.plan.steps:
        known |= {*step.frequency}
        for name in step.start:
            if name not in known:
                warn(f"{name} is started at the setpoint that it has, because no earlier step sets one")
    most = max((hz for step in test.plan.steps for hz in step.frequency.values()), default=None)
    at_most = "" if most is None else f" at up to {most:g} Hz"
    names = ", ".join(drive.name for drive in drives) or "no drive"
    confirm(
        f"Run {arguments.test}, which commands {names}{at_most}, and then stops all drives of the plant?",
        arguments,
    )


def _unseen_faults(test: TestRun) -> dict[str, str]:
    """Return, by drive name, a sentence for each drive of the test whose faults do not abort the run."""
    found = {}
    for name in test.plan.drives:
        polled = polled_drive(test.plan.plant, name)
        if not can_show_fault(polled.drive, [poll.register.name for poll in polled.polls]):
            found[name] = f"no polled register of {name} shows a fault, so a fault does not abort the run"
    return found


@contextmanager
def _screen(test: TestRun, arguments: argparse.Namespace) -> Iterator[list[Callable[[Rows], object]]]:
    """Yield a list with the function that shows polled rows in a live table.

    Without a terminal or with --json, the list is empty.
    """
    if arguments.json or not sys.stdout.isatty():
        yield []
        return
    is_ending = False
    table = LiveTable(test.plan.plant, sys.stdout, lambda: STOPPING if is_ending else _progress(test))
    with table.showing_warnings():

        def show(rows: Rows) -> None:
            nonlocal is_ending
            table.add(rows)
            # The signal printed a message: draw the next table below it, not over it.
            if not is_ending and signal_has_come():
                is_ending = True
                table.keep_drawing(time.monotonic())
            table.draw_if_due(time.monotonic())

        yield [show]


def _progress(test: TestRun) -> str:
    """Return the present step and the elapsed time, such as "step 3 of 12, warm up: wait; 12 s of 60 s"."""
    if test.phase in ("", STOP):
        return STOPPING if test.phase else "checking the drives"
    step = test.timeline[test.number].step
    return (
        f"step {test.number + 1} of {len(test.timeline)}, {step.name}: {step}; "
        f"{test.elapsed:.0f} s of {length(test.timeline):.0f} s"
    )


def _conclude(result: RunResult, arguments: argparse.Namespace) -> int:
    if arguments.json:
        stops = [
            {"drive": stopped.drive, "seen": stopped.seen.value, "why": stopped.why}
            for stopped in result.stopped.values()
        ]
        recording = str(arguments.out) if arguments.out else None
        found = {"ok": result.ok, "abort": result.abort, "stops": stops, "recording": recording}
        print_json(found)
    else:
        print_text("\n".join(map(stop_sentence, result.stopped.values())))
        if arguments.out:
            print_text(f"recorded in {arguments.out}; next: multidrop report {arguments.out}")
    if result.abort:
        warn(f"the run was aborted: {result.abort}")
    return DONE if result.ok else FAILED


# ---- the dry run ----


def _show(test: TestRun, arguments: argparse.Namespace) -> int:
    """Print the planned times; return the exit status: FAILED if a line is too slow for the test."""
    misfits = test.misfits()
    if arguments.json:
        print_json({"steps": [*_steps(test)], "misfits": misfits})
    else:
        print_text("\n".join(_text(test)))
        for sentence in misfits:
            print_text(f"! {sentence}")
    return FAILED if misfits else DONE


def _steps(test: TestRun) -> Iterator[dict[str, Any]]:
    for planned in test.timeline:
        step = planned.step
        yield {
            "at_s": round(planned.begin, 3),
            "is_latest": planned.is_latest,
            "seconds": round(planned.seconds, 3),
            "within_s": step.within,
            "phase": step.name,
            "commands": str(step),
        }


def _text(test: TestRun) -> Iterator[str]:
    rows = [("AT", "LASTS", "PHASE", "COMMANDS")]
    for planned in test.timeline:
        step = planned.step
        at = f"{'at most ' if planned.is_latest else ''}{planned.begin:g} s"
        most = f" to {planned.seconds + step.within:g}" if step.until else ""
        rows.append((at, f"{planned.seconds:g}{most} s", step.name, str(step)))
    yield from aligned(rows, ">><<")
    until = "at most " if any(planned.step.until for planned in test.timeline) else ""
    yield f"{counted(len(test.timeline), 'step')} in {until}{length(test.timeline):g} s, then all drives stop"
    limits = test.plan.limits
    reasons = [condition.text for condition in limits.conditions]
    reasons += [f"no value for {silence_of(test.plan):g} s", "a failed command"]
    reasons += [f"more than {limits.duration:g} s"] if limits.duration else []
    unseen = _unseen_faults(test)
    reasons += [f"a fault of {name}" for name in test.plan.drives if name not in unseen]
    yield from (f"! {sentence}" for sentence in unseen.values())
    yield f"aborts: {'; '.join(reasons)}"
