"""Drills in network namespaces whose cables are cut; each gateway and each node has its own.

The lines have their own network, and are cut only if a gateway is cut off completely. A second drill has
machines with one gateway and one node each, which die or are cut off together.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fleet_drills import GATEWAYS, FleetDrill
from namespaces import Namespace, network
from nats_clusters import cluster

NODES = 3


class Cuts:
    """Cuts of a drill's cables; every cut heals after 1 to 8 s."""

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
        """Cut a gateway and its lines, which leaves unsent frames in its buffers."""
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
        """Cut off a gateway with one node: they reach only each other."""
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
    """Cut by this name, and heal after this long; 0 means 1 to 8 s."""
    cuts = Cuts(drill)
    CUTS[name](cuts)
    time.sleep(seconds or drill.random.uniform(1, 8))
    for one in (*cuts.gateways, *cuts.nodes):
        one.heal([other for other in (*cuts.gateways, *cuts.nodes) if other is not one])


@contextmanager
def drilled_in_network(folder: Path, lines: int = 12, seed: int = 1) -> Iterator[FleetDrill]:
    """Give a fleet like `drilled` in namespaces; `network` skips or fails if there are none."""
    with (
        network(NODES + len(GATEWAYS)) as made,
        cluster(folder / "nats", places=made.namespaces[:NODES]) as nats,
    ):
        places = dict(zip(GATEWAYS, made.namespaces[NODES:], strict=True))
        drill = FleetDrill(folder, nats, lines, seed, places, made.address)
        try:
            yield drill
        finally:
            drill.close()


class MachineDrill(FleetDrill):
    """Machines with one gateway and one node each."""

    def kill_machine(self) -> None:
        name = self.random.choice(GATEWAYS)
        [node] = [node for node in self.nats.nodes if node.place is self.places[name]]
        node.kill()
        self.gateways[name].kill()
        self.gateways[name].wait()

    def kill_gateway_and_another_node(self) -> None:
        """Kill a gateway, and at the same moment a node on another machine."""
        name = self.random.choice(GATEWAYS)
        others = [node for node in self.nats.nodes if node.place is not self.places[name]]
        self.random.choice(others).kill()
        self.gateways[name].kill()
        self.gateways[name].wait()

    def cut_machine(self) -> None:
        cut(self, "gateway cut off", seconds=self.random.uniform(4, 8))


MACHINES: dict[str, Callable[[MachineDrill], None]] = {
    "machine killed": MachineDrill.kill_machine,
    "machine cut off": MachineDrill.cut_machine,
    "gateway and another machine's node killed": MachineDrill.kill_gateway_and_another_node,
}


@contextmanager
def drilled_on_machines(folder: Path, lines: int = 12, seed: int = 1) -> Iterator[MachineDrill]:
    """Give a fleet on three machines; `network` skips or fails without namespaces."""
    with (
        network(NODES) as made,
        cluster(folder / "nats", places=made.namespaces) as nats,
    ):
        places = dict(zip(GATEWAYS, made.namespaces, strict=True))
        drill = MachineDrill(folder, nats, lines, seed, places, made.address)
        try:
            yield drill
        finally:
            drill.close()
