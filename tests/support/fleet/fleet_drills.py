"""Fleet drills: gateway processes, three NATS nodes, and serial servers that record who sends when."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from unittest.mock import patch

from commands import kill_all
from namespaces import Namespace, network
from nats_clusters import Cluster, Node, cluster
from serial_hall import SerialHall

from multidrop.cli import main
from multidrop.fleet.errors import Conflict, FleetError
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import LeaseBucket, ask
from multidrop.fleet.servers.connections import ServerPath

GATEWAYS = ("gw-a", "gw-b", "gw-c")
PATIENCE_S = 120.0
# Lines are watched for so many seconds after an attack, because an election may start 9 s after it.
JUDGED_S = 11.0
SOON_S = 2.0  # the same in a test that then calls `settle`, which itself waits for elections


class CommandEnd(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def run_here(environment: Mapping[str, str], *words: str) -> CommandEnd:
    """Run a `multidrop` command in this process, because a new one would take a second of CPU to start."""
    out, err = StringIO(), StringIO()
    with (
        patch.dict(os.environ, environment),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        status = main([*words])
    return CommandEnd(status, out.getvalue(), err.getvalue())


class FleetProcesses:
    """The gateway processes of a fleet that `fleet init` created from this plant file."""

    def __init__(
        self, folder: Path, nats: Cluster, plant: str, places: Mapping[str, Namespace] | None = None
    ) -> None:
        self.folder = folder
        self.nats = nats
        self.places = places or {}  # network namespaces by gateway; other gateways run without one
        self._environment = {
            **os.environ,
            "MULTIDROP_NATS": ",".join(nats.urls),
            "XDG_STATE_HOME": str(folder / "state"),
        }
        self.gateways: dict[str, subprocess.Popen[str]] = {}
        (folder / "plant.toml").write_text(plant)
        made = self.run("init", str(folder / "plant.toml"))
        assert made.returncode == 0, made.stderr

    def run(self, *words: str) -> CommandEnd:
        return run_here(self._environment, "fleet", *words)

    def status(self) -> dict[str, Any]:
        return fleet_status(self._environment)

    def start(self, *names: str) -> None:
        for name in names:
            prefix = self.places[name].prefix if name in self.places else []
            with (self.folder / f"{name}.log").open("a") as log:
                self.gateways[name] = subprocess.Popen(
                    [*prefix, sys.executable, "-m", "multidrop", "fleet", "serve", name],
                    env=self._environment,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    text=True,
                    preexec_fn=partial(signal.signal, signal.SIGHUP, signal.SIG_DFL),  # undoes nohup
                )

    def kill(self, name: str) -> None:
        self.gateways[name].kill()
        self.gateways[name].wait()

    def suspend(self, name: str, seconds: float) -> subprocess.Popen[str]:
        """Suspend a gateway for `seconds`; return its process, which the kernel may have killed."""
        running = self.gateways[name]
        running.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        running.send_signal(signal.SIGCONT)
        return running

    def suspend_node(self, node: Node, seconds: float) -> None:
        node.pause()
        time.sleep(seconds)
        node.go_on()

    def close(self) -> None:
        kill_all(self.gateways.values())


class FleetDrill(FleetProcesses):
    """Rounds of attacks on a fleet; each measures the longest time without requests on each line."""

    def __init__(
        self,
        folder: Path,
        nats: Cluster,
        lines: int = 12,
        seed: int = 1,
        places: Mapping[str, Namespace] | None = None,
        host: str = "127.0.0.1",
    ) -> None:
        self.hall = SerialHall(lines, host)
        self.random = random.Random(seed)
        super().__init__(folder, nats, self.hall.plant(), places)

    def settle(self) -> None:
        """Restart dead processes; wait until lines are polled, and leases and leaders are as at the start."""
        for node in self.nats.nodes:
            with suppress(ProcessLookupError):
                node.go_on()
            if node.process.poll() is not None:
                node.start()
        self.nats.wait()

        def are_polled() -> bool:
            self._start_what_died()
            return self.hall.are_polled(0.5)

        def is_shared() -> bool:
            self._start_what_died()
            found = self.status()
            return len(found["gateways"]) == len(GATEWAYS) and all(
                one["lines"]
                and one["says"]
                and not one["says"]["trouble"]
                and len(set(one["says"]["paths"])) == len(self.nats.nodes)
                for one in found["gateways"].values()
            )

        self.wait(are_polled, "all lines are polled")
        self.wait(is_shared, "each gateway has lines, a whole lease, and paths to three nodes")
        self.wait(self.are_leaders_home, "each node leads one bucket of the leases")
        time.sleep(1.0)

    def _start_what_died(self, besides: Collection[str] = ()) -> None:
        """Restart dead gateways, because the kernel kills those that a busy machine suspends too long."""
        for name in GATEWAYS:
            running = self.gateways.get(name)
            if name not in besides and (running is None or running.poll() is not None):
                self.start(name)

    def are_leaders_home(self) -> bool:
        """Return True if each node is the NATS leader of one bucket of each group."""
        leads = [node.leads() for node in self.nats.nodes]
        return all(
            sum(f"KV_{bucket}" in found for bucket in group) == 1
            for found in leads
            for group in (names.LEASES, names.OWNERS)
        )

    def wait(self, condition: Callable[[], bool], what: str) -> float:
        begun = time.monotonic()
        while not condition():
            assert time.monotonic() - begun < PATIENCE_S, what
            time.sleep(0.05)
        return time.monotonic() - begun

    def judge(self, deed: Callable[[], object], seconds: float = JUDGED_S) -> dict[str, float]:
        """Call `deed`; return each line's longest gap (s) without requests in the next `seconds`."""
        self.hall.reset()
        deed()
        killed = [name for name in GATEWAYS if self.gateways[name].poll() is not None]
        time.sleep(seconds)

        def are_polled() -> bool:
            self._start_what_died(besides=killed)
            return self.hall.are_polled(1.0)

        self.wait(are_polled, "all lines are polled again")
        return self.hall.gaps()

    def do_nothing(self) -> None:
        """Do nothing, to measure the gaps between requests that are usual on this machine."""

    def kill_gateway(self) -> None:
        self.kill(self.random.choice(GATEWAYS))

    def kill_two_gateways(self) -> None:
        for name in self.random.sample(GATEWAYS, 2):
            self.kill(name)

    def kill_gateway_and_node(self) -> None:
        self.kill_gateway()
        self.kill_node()

    def stop_gateway(self) -> subprocess.Popen[str]:
        """Suspend a gateway for longer than its lease, so the kernel kills it; return its process."""
        return self.suspend(self.random.choice(GATEWAYS), self.random.uniform(3.5, 6.0))

    def stop_gateway_shortly(self) -> None:
        self.suspend(self.random.choice(GATEWAYS), self.random.uniform(0.2, 3.2))

    def kill_node(self) -> None:
        self.random.choice(self.nats.nodes).kill()

    def end_one_record(self) -> None:
        """Delete one record of a lease, as happens if a gateway renews it slightly too late."""
        asyncio.run(_end_record(self.nats, self.random.choice(GATEWAYS), self.random.choice(names.LEASES)))

    def stop_node(self) -> None:
        self.suspend_node(self.random.choice(self.nats.nodes), self.random.uniform(1, 6))

    def leader_alone(self, group: Sequence[str], others: Sequence[str]) -> Node:
        """Return a node that leads one bucket of `group`, and no bucket of `others`."""
        bucket = self.random.choice(group)
        while True:
            leads = {node.name: node.leads() for node in self.nats.nodes}
            for node in self.nats.nodes:
                if f"KV_{bucket}" in leads[node.name]:
                    too_much = [other for other in others if f"KV_{other}" in leads[node.name]]
                    if not too_much:
                        return node
                    elsewhere = self.random.choice([one for one in self.nats.nodes if one is not node])
                    asyncio.run(_make_leader(elsewhere, too_much))
            time.sleep(0.05)

    def kill_leader(self, group: Sequence[str], others: Sequence[str]) -> None:
        self.leader_alone(group, others).kill()

    def stop_leader(self, group: Sequence[str], others: Sequence[str]) -> None:
        self.suspend_node(self.leader_alone(group, others), self.random.uniform(1, 6))

    def kill_all_nodes(self) -> None:
        for node in self.nats.nodes:
            node.kill()
        time.sleep(1)
        for node in self.nats.nodes:
            node.start()

    def close(self) -> None:
        super().close()
        self.hall.close()


async def _make_leader(node: Node, buckets: Sequence[str]) -> None:
    path = ServerPath([node.url])
    await path.open()
    for bucket in buckets:
        with suppress(FleetError):  # the caller of this function tries again
            await ask(path, f"STREAM.LEADER.STEPDOWN.KV_{bucket}", {"placement": {"preferred": node.name}})
    await path.close()


async def _end_record(nats: Cluster, gateway: str, bucket: str) -> None:
    path = ServerPath(nats.urls)
    await path.open()
    other = LeaseBucket(bucket, lambda: path, "another")
    while True:
        record = await other.get(gateway)
        with suppress(Conflict):  # the gateway renewed the record after it was read
            await other.put(gateway, {**record.value, "ended": True}, record.revision)
            break
    await path.close()


DEEDS: dict[str, Callable[[FleetDrill], object]] = {
    "nothing": FleetDrill.do_nothing,
    "gateway killed": FleetDrill.kill_gateway,
    "two gateways killed": FleetDrill.kill_two_gateways,
    "gateway and node killed": FleetDrill.kill_gateway_and_node,
    "gateway stands still": FleetDrill.stop_gateway,
    "gateway stands still shortly": FleetDrill.stop_gateway_shortly,
    "gateway's lease loses a record": FleetDrill.end_one_record,
    "node killed": FleetDrill.kill_node,
    "node stands still": FleetDrill.stop_node,
    "lease leader killed": partial(FleetDrill.kill_leader, group=names.LEASES, others=names.OWNERS),
    "lease leader stands still": partial(FleetDrill.stop_leader, group=names.LEASES, others=names.OWNERS),
    "ownership leader killed": partial(FleetDrill.kill_leader, group=names.OWNERS, others=names.LEASES),
    "ownership leader stands still": partial(FleetDrill.stop_leader, group=names.OWNERS, others=names.LEASES),
    "all nodes killed": FleetDrill.kill_all_nodes,
}


D = TypeVar("D", bound=FleetDrill)


@contextmanager
def judged_at_end(drills: AbstractContextManager[D]) -> Iterator[D]:
    """Yield a fleet; at the end, wait for its last elections and check that no line had two masters."""
    with drills as drill:
        yield drill
        drill.settle()
        assert drill.hall.overlaps() == 0


@contextmanager
def drilled(folder: Path, lines: int = 12, seed: int = 1) -> Iterator[FleetDrill]:
    with cluster(folder / "nats") as nats, closing(FleetDrill(folder, nats, lines, seed)) as drill:
        yield drill


LOOK_S = 0.25  # pause in s before each query of the state, which needs much CPU time


def fleet_status(environment: Mapping[str, str]) -> dict[str, Any]:
    """Return the fleet's state as a dict; empty if the servers return no state, as during an election."""
    time.sleep(LOOK_S)
    status, out, _ = run_here(environment, "fleet", "status", "--json")
    if status and not out:
        return {"gateways": {}, "lines": {}}
    found: dict[str, Any] = json.loads(out)
    silent = {name for name, gateway in found["gateways"].items() if gateway["says"] is None}
    lost = any(gateway["says"]["lost"] for gateway in found["gateways"].values() if gateway["says"])
    is_unpolled = any(line["master"] in {None, *silent} for line in found["lines"].values())
    assert status == int(is_unpolled or lost or bool(found["missing"]))
    return found


# ---- drills in network namespaces whose connections are cut ----

NODES = 3


class Cuts:
    """Network cuts for a drill; every cut is undone after 1 to 8 s."""

    def __init__(self, drill: FleetDrill) -> None:
        self.drill = drill
        self.dice = drill.random
        self.gateways = list(drill.places.values())
        self.nodes = [node.place for node in drill.nats.nodes if node.place]

    def _lost(self, senders: Sequence[Namespace], receivers: Sequence[Namespace]) -> None:
        for sender in senders:
            sender.cut_to(one for one in receivers if one is not sender)

    def _part(self, some: Sequence[Namespace], others: Sequence[Namespace]) -> None:
        self._lost(some, others)
        self._lost(others, some)

    def gateway(self) -> None:
        """Cut a gateway off from everything, even its lines; unsent frames stay in its socket buffers."""
        self.dice.choice(self.gateways).cut()

    def gateway_from_nodes(self) -> None:
        self._part([self.dice.choice(self.gateways)], self.nodes)

    def gateway_is_not_heard(self) -> None:
        self._lost([self.dice.choice(self.gateways)], self.nodes)

    def gateway_hears_nothing(self) -> None:
        self._lost(self.nodes, [self.dice.choice(self.gateways)])

    def node(self) -> None:
        self.dice.choice(self.nodes).cut()

    def node_is_not_heard(self) -> None:
        self._lost([self.dice.choice(self.nodes)], [*self.nodes, *self.gateways])

    def node_hears_nothing(self) -> None:
        self._lost([*self.nodes, *self.gateways], [self.dice.choice(self.nodes)])

    def gateway_and_node(self) -> None:
        """Cut off a gateway together with one node, so that they reach only each other."""
        inside = [self.dice.choice(self.gateways), self.dice.choice(self.nodes)]
        self._part(inside, [one for one in (*self.gateways, *self.nodes) if one not in inside])


CUTS: dict[str, Callable[[Cuts], None]] = {
    "gateway cut off": Cuts.gateway,
    "gateway cut off from the nodes": Cuts.gateway_from_nodes,
    "nodes do not hear a gateway": Cuts.gateway_is_not_heard,
    "gateway does not hear the nodes": Cuts.gateway_hears_nothing,
    "node cut off": Cuts.node,
    "nobody hears a node": Cuts.node_is_not_heard,
    "node hears nobody": Cuts.node_hears_nothing,
    "gateway and node cut off": Cuts.gateway_and_node,
}


def cut(drill: FleetDrill, name: str, seconds: float = 0.0) -> None:
    """Make the cut with this name, and undo it after `seconds`; 0 means 1 to 8 s."""
    cuts = Cuts(drill)
    CUTS[name](cuts)
    time.sleep(seconds or drill.random.uniform(1, 8))
    for one in (*cuts.gateways, *cuts.nodes):
        one.heal([other for other in (*cuts.gateways, *cuts.nodes) if other is not one])


@contextmanager
def drilled_in_network(folder: Path, lines: int = 12, seed: int = 1) -> Iterator[FleetDrill]:
    """Yield a fleet in network namespaces; skip or fail the test if the machine allows no namespaces."""
    with (
        network(NODES + len(GATEWAYS)) as made,
        cluster(folder / "nats", places=made.namespaces[:NODES]) as nats,
    ):
        places = dict(zip(GATEWAYS, made.namespaces[NODES:], strict=True))
        with closing(FleetDrill(folder, nats, lines, seed, places, made.address)) as drill:
            yield drill


class MachineDrill(FleetDrill):
    """A drill on simulated machines, each with one gateway and one NATS node."""

    def kill_machine(self) -> None:
        name = self.random.choice(GATEWAYS)
        [node] = [node for node in self.nats.nodes if node.place is self.places[name]]
        node.kill()
        self.kill(name)

    def kill_gateway_and_another_node(self) -> None:
        """Kill a gateway, and at the same moment a node on another machine."""
        name = self.random.choice(GATEWAYS)
        others = [node for node in self.nats.nodes if node.place is not self.places[name]]
        self.random.choice(others).kill()
        self.kill(name)

    def cut_machine(self) -> None:
        cut(self, "gateway cut off", seconds=self.random.uniform(4, 8))


MACHINES: dict[str, Callable[[MachineDrill], None]] = {
    "machine killed": MachineDrill.kill_machine,
    "machine cut off": MachineDrill.cut_machine,
    "gateway and another machine's node killed": MachineDrill.kill_gateway_and_another_node,
}


@contextmanager
def drilled_on_machines(folder: Path, lines: int = 12, seed: int = 1) -> Iterator[MachineDrill]:
    """Yield a fleet on three simulated machines; skip or fail if the machine allows no namespaces."""
    with network(NODES) as made, cluster(folder / "nats", places=made.namespaces) as nats:
        places = dict(zip(GATEWAYS, made.namespaces, strict=True))
        with closing(MachineDrill(folder, nats, lines, seed, places, made.address)) as drill:
            yield drill
