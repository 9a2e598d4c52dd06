"""Stops under attack: does a motor turn after its stop, and how soon is the stop on the wire?

Client processes are attacked from outside by signals, lines that do not answer, suspensions and cut networks,
and from inside by threads that start motors. The simulated drives do not use the library. Exits with 1 if a
motor turns after its stop, or if a drive gets a frame after its stop that moves the motor. The same seed
makes the same attacks.
"""

from __future__ import annotations

import argparse
import itertools
import random
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterator

from responder_drives import KINDS

from bench.players.stop_network import cut_networks
from bench.players.stop_victim import Counters, Victim, victim
from bench.support import tables

SIGNALS = (signal.SIGINT, signal.SIGTERM)
ALL = [(kind, address) for address, kind in enumerate((*KINDS, "yd1000"), 1)]
REFUSALS: dict[str, tuple[int, ...]] = {  # exception codes that answer a stop's first reads, by family
    "erman-er-g-220": (2,),
    "invt-che": (0x11, 0x06),
    "innovert-ibd": (6,),
    "delixi-modbus": (6,),
    "delixi-native": (0xFF,),
    "yd1000": (4,),
    "fan": (1,),
}
MOST_READS = 8  # limit of the reads that a start makes before its write
LATE, PATIENCE = 0.6, 3.0  # s: delay that makes replies too late to confirm a stop; limit for a stop
CUT_SHORT = "cut short"  # printed by a client if a third signal cuts its stops short
PAUSE = 2.5  # s of suspension; a start and its reads expire sooner
Attack = Callable[[random.Random, int, bool], Counters]


def _in_turn(chance: random.Random) -> Iterator[str]:
    return itertools.cycle(chance.sample(list(KINDS), len(KINDS)))


def signals(number: int, leaving: bool) -> Attack:
    """Return a test that sends `number` signals to a client at random moments, while its motors turn.

    With `leaving`, the client is already exiting; otherwise it is idle. If a client gets three signals and
    reports that its stops were aborted, a motor that still turns is not counted as a failure.
    """

    def attack(chance: random.Random, rounds: int, is_long: bool) -> Counters:
        counters = Counters()
        for _ in range(rounds):
            with victim([ALL], on_exit=True) as client:
                client.begin(turning=True)
                if leaving:
                    client.leave()
                    client.asked_ns = client.hear("leaving")["at"]
                sent = []
                for at in range(number):
                    time.sleep(chance.uniform(0.001, 0.2 if leaving and not at else 0.05))
                    sent.append(chance.choice(SIGNALS))
                    client.signal(sent[-1])
                client.wait()
                cut_short = number > 2 and CUT_SHORT in client.errors
                client.judge(counters, f"signals {[each.name for each in sent]}", excuse=cut_short)
        return counters

    return attack


def signal_during_start(chance: random.Random, rounds: int, is_long: bool) -> Counters:
    """Send a signal to the client while one of its threads starts a motor."""
    counters, kinds = Counters(), _in_turn(chance)
    for _, kind in zip(range(rounds), kinds, strict=False):
        with victim([[(kind, 1)]], on_exit=True, sets=True) as client:
            client.begin(turning=False)
            client.hold(chance.randint(0, MOST_READS))
            client.ask(do="start_aside", drive=0, verb="start")
            client.hear("asked")
            client.lines[0].held.wait(chance.uniform(0, 0.2))
            client.signal(chance.choice(SIGNALS))
            client.release()
            client.wait()
            client.judge(counters, "signal while it starts")
    return counters


def race(chance: random.Random, rounds: int, is_long: bool) -> Counters:
    """Start a motor in one thread of the client, and stop it in another thread during the start."""
    counters = Counters()
    for kind, known in KINDS.items():
        with victim([[(kind, 1)]], sets=True) as client:
            for _ in range(rounds):
                client.begin(turning=False)
                client.hold(chance.randint(0, MOST_READS))
                stop = chance.choice((*known.halts, "stop_all"))
                client.ask(do="race", drive=0, verb="start", after=chance.uniform(0, 0.1), stop=stop)
                client.asked_ns = client.hear("asked")["at"]
                client.release()
                said = client.hear("called")
                client.judge(counters, f"start against {stop} ({said['failure'] or 'done'})")
                client.lines[0].drives[1].switch_on()
    return counters


def deaf(chance: random.Random, rounds: int, is_long: bool) -> Counters:
    """Call a stop while no drive on the line answers for a while."""
    counters = Counters()
    for _ in range(rounds):
        seconds = chance.uniform(2.0, 20.0) if is_long else 1.2
        for how in ("stop_all", "call"):
            kind = chance.choice(list(KINDS))
            with victim([ALL] if how == "stop_all" else [[(kind, 1)]]) as client:
                client.begin(turning=True)
                client.lines[0].deaf_until = time.monotonic() + seconds
                command = {} if how == "stop_all" else {"drive": 0, "verb": "stop"}
                client.ask(do=how, **command)
                client.asked_ns = client.hear("asked")["at"]
                client.hear("called")
                client.judge(counters, f"{how} while deaf for {seconds:.1f} s")
    return counters


def two_lines(*, polls: bool) -> Attack:
    """Return a test that ends a client by a signal: it must stop the slow motors of both its lines."""

    def attack(chance: random.Random, rounds: int, is_long: bool) -> Counters:
        counters = Counters()
        for _ in range(rounds):
            ramp = 10.0 if is_long else 1.5
            with victim([ALL[:4], ALL[4:]], on_exit=True, polls=polls, ramp=ramp) as client:
                client.begin(turning=True)
                client.signal(chance.choice(SIGNALS))
                client.wait()
                client.judge(counters, "two lines of a poller" if polls else "two buses")
        return counters

    return attack


def failing_reads(chance: random.Random, rounds: int, is_long: bool) -> Counters:
    """Stop a drive that refuses the first reads, then a drive that replies to each request 0.6 s late."""
    counters = Counters()
    for _ in range(rounds):
        for kind, codes in REFUSALS.items():
            with victim([[(kind, 1)]]) as client:
                client.lines[0].troubles = [chance.choice(codes)] * chance.randint(1, 2)
                _stop(client, counters, f"{len(client.lines[0].troubles)} exceptions")
        for kind in KINDS if is_long else chance.sample(list(KINDS), 1):
            with victim([[(kind, 1)]]) as client:
                client.lines[0].delay = LATE
                _stop(client, counters, f"answers {LATE:g} s late", seconds=PATIENCE)
    return counters


def _stop(client: Victim, counters: Counters, why: str, **more: float) -> None:
    client.begin(turning=True)
    client.ask(do="call", drive=0, verb="stop", **more)
    client.asked_ns = client.hear("asked")["at"]
    said = client.hear("called")
    client.judge(counters, f"stop, {why} ({said['failure'] or 'done'})")


def paused(chance: random.Random, rounds: int, is_long: bool) -> Counters:
    """Suspend the client during a start for longer than the start's expiry; then no motor may move."""
    counters, kinds = Counters(), _in_turn(chance)
    for _, kind in zip(range(rounds), kinds, strict=False):
        with victim([[(kind, 1)]], sets=True) as client:
            client.begin(turning=False)
            client.hold(chance.randint(0, 3))
            client.ask(do="call", drive=0, verb="start")
            client.lines[0].held.wait(0.2)
            client.process.send_signal(signal.SIGSTOP)
            client.release()
            time.sleep(PAUSE)
            known = len(client.lines[0].log)
            client.process.send_signal(signal.SIGCONT)
            client.hear("called")
            counters.rounds += 1
            late = [each for each in client.lines[0].log[known:] if each.what == "moves"]
            counters.moved += len(late)
            counters.stories += [f"start of {kind} after a pause of {PAUSE:g} s: {each}" for each in late]
    return counters


ATTACKS: dict[str, tuple[Attack, float]] = {  # attack's name: its function, and its share of all rounds
    "a signal while it runs": (signals(1, leaving=False), 0.5),
    "two signals": (signals(2, leaving=False), 1),
    "three signals": (signals(3, leaving=False), 0.5),
    "a signal while it leaves": (signals(1, leaving=True), 1),
    "two signals while it leaves": (signals(2, leaving=True), 0.5),
    "a signal while it starts": (signal_during_start, 1.5),
    "start against stop": (race, 1),
    "a deaf line": (deaf, 0.5),
    "two buses": (two_lines(polls=False), 0.5),
    "two lines of a poller": (two_lines(polls=True), 0.5),
    "reads that fail": (failing_reads, 0.5),
    "a pause while it starts": (paused, 1),
    "a cut network": (cut_networks, 0.5),
}
HEAD: tuple[str, ...] = ("attack", "rounds", "stops", "left turning", "moved after", "not sent", "cut short")
HEAD += ("first p50 ms", "p99", "longest")


def row(name: str, counters: Counters) -> tuple[object, ...]:
    found = sorted(counters.first_ms) or [0.0]
    cuts = statistics.quantiles(found, n=100, method="inclusive") if len(found) > 1 else found * 99
    counts = (
        counters.rounds,
        counters.asked,
        counters.turning,
        counters.moved,
        counters.unsent,
        counters.excused,
    )
    return (name, *counts, f"{cuts[49]:.0f}", f"{cuts[98]:.0f}", f"{found[-1]:.0f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20, help="2 take half a minute")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=ATTACKS, action="append", help="of the attacks; may be repeated")
    parser.add_argument("--stories", action="store_true", help="print each failed stop")
    arguments = parser.parse_args()
    tables.heading("Stops of clients under attack; times are from the request to the first stop on the wire.")
    rows, failures, stories = [], 0, []
    for name in arguments.only or ATTACKS:
        attack, share = ATTACKS[name]
        rounds = max(1, round(arguments.rounds * share))
        chance = random.Random(f"{arguments.seed} {name}")
        begun = time.monotonic()
        counters = attack(chance, rounds, arguments.rounds > 4)
        print(f"{name}: {time.monotonic() - begun:.0f} s", file=sys.stderr)
        rows.append(row(name, counters))
        failures += counters.failures
        stories += counters.stories
    tables.show(HEAD, rows)
    if arguments.stories:
        print("", *stories, sep="\n")
    print(f"\n{failures} that should not be" if failures else "\nno motor turns that was stopped")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
