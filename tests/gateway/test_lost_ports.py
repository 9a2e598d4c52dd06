"""If a port is missing when the gateway starts, its line is lost, and the other lines are polled."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
from gateways import Served, plant_text, running, tokens, written
from lines import until

from multidrop import InvtCHE, Plant
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.settings import read_settings
from multidrop.sim import Simulator, Wire, simulated

SERVE = '[serve]\nlisten = "127.0.0.1:0"\n[serve.may]\nstop = "anyone"\n'


@pytest.mark.slow
def test_line_with_a_missing_port_is_polled_as_soon_as_the_port_appears(tmp_path: Path) -> None:
    port = tmp_path / "late"
    sims = [simulated(InvtCHE(1, name=name, baudrate=38400)) for name in ("pump-1", "fan-1")]
    with Simulator([Wire([sim], unpaced=True) for sim in sims]) as simulator:
        text = plant_text(simulator.wires[0].path, ["pump-1"])
        text += plant_text(str(port), ["fan-1"], SERVE).replace('"hall"', '"roof"')
        (tmp_path / "plant.toml").write_text(text)
        plant = Plant.load(tmp_path / "plant.toml")
        gateway = Gateway(plant, read_settings(plant, {}))
        with running(gateway):
            served = Served(gateway, dict(zip(("pump-1", "fan-1"), sims, strict=True)), tokens()[0])
            served.await_state("pump-1", "stands")
            served.await_state("fan-1", "silent")
            lost = served.frame()["lines"]["roof"]["lost"]
            assert lost == f"{port}: there is no such port"
            assert served.get("/api/lines").json["roof"]["lost"] == lost
            health = served.get("/health")
            assert (health.status, health.json["status"]) == (200, "degraded")
            assert health.json["lines"] == {"hall": "ok", "roof": lost}
            metrics = served.get("/metrics").body.decode()
            assert 'multidrop_line_up{line="hall"} 1.0\n' in metrics
            assert 'multidrop_line_up{line="roof"} 0.0\n' in metrics
            assert served.post("/api/stop", {"drives": ["pump-1"]}).json["pump-1"]["done"] is True

            port.symlink_to(simulator.wires[1].path)
            served.await_state("fan-1", "stands")
            assert served.get("/health").json["lines"] == {"hall": "ok", "roof": "ok"}
            until(lambda: 'multidrop_line_up{line="roof"} 1.0\n' in served.get("/metrics").body.decode())
            until(lambda: not gateway.hub.unopened)
            assert served.get("/health").json["status"] == "ok"


@pytest.mark.slow
def test_reason_of_a_port_lost_later_is_reported(tmp_path: Path) -> None:
    port = tmp_path / "hall"
    plant = written(tmp_path, SERVE, port=str(port))
    gateway = Gateway(plant, read_settings(plant, {}))
    with ExitStack() as stack:
        with Simulator([Wire([simulated(InvtCHE(1, baudrate=38400))], unpaced=True, port=str(port))]):
            stack.enter_context(running(gateway))
            served = Served(gateway, {}, tokens()[0])
            served.await_state("pump-1", "stands")
        told = {"hall": f"{port}: there is no such port"}
        until(lambda: served.get("/health").json["lines"] == told)
        until(lambda: gateway.status == "STATUS=polling 0 lines; 1 lost")
        assert served.get("/health").json["status"] == "degraded"


def test_an_invalid_port_leaves_no_socket_open(tmp_path: Path) -> None:
    plant = written(tmp_path, SERVE)
    plant = replace(plant, lines=(plant.lines[0].at("nosuch://port"),))  # not allowed in a plant file
    gateway = Gateway(plant, read_settings(plant, {}))
    with pytest.raises(ValueError, match="nosuch"), running(gateway):
        pass
    assert gateway.listener.fileno() == -1
