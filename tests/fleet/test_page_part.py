"""The part `fleet` of `serve`: its settings, its health, and its view of a real fleet."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import pytest
from gateways import served, written
from lines import until
from nats_clusters import Cluster, free_ports

from multidrop import PlantError
from multidrop.fleet.overview import FleetView, FleetWatch
from multidrop.fleet.page_part import FleetPart
from multidrop.fleet.servers.connections import ServerPath
from multidrop.gateway.settings import read_settings


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ("nats = []", "nats = [] is not right; write nats = ["),
        (
            'nats = ["10.0.0.1"]',
            "nats: '10.0.0.1' is not an address of a NATS server; write nats = [\"nats://127",
        ),
        ("nats = [5]", "nats: 5 is not an address of a NATS server"),
        ('nats = "nats://a:4222"', "nats = 'nats://a:4222' is not right; write nats = ["),
        ("every = 5", "every"),
    ],
)
def test_each_mistake_in_the_fleet_table_is_reported(tmp_path: Path, table: str, sentence: str) -> None:
    with pytest.raises(PlantError) as raised:
        read_settings(written(tmp_path, f"[serve.fleet]\n{table}\n"), {})
    assert sentence in str(raised.value)


def test_fleet_settings_are_checked_without_the_nats_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`serve --check` works without the library, and `serve` reports what to install."""
    for name in [name for name in sys.modules if name.split(".")[0] == "nats"]:
        monkeypatch.setitem(sys.modules, name, None)
    for name in [name for name in sys.modules if name.startswith("multidrop.fleet")]:
        monkeypatch.delitem(sys.modules, name)
    settings = read_settings(written(tmp_path, "[serve.fleet]\n"), {})
    assert settings.parts["fleet"].nats == ("nats://127.0.0.1:4222",)
    from multidrop.gateway import parts

    with pytest.raises(ValueError, match=r"it needs nats.*, which is not installed: pip install 'nats-py"):
        parts.build("fleet", settings.parts["fleet"], None)  # type: ignore[arg-type]


@pytest.mark.parametrize("dying", ["path", "watch"])
def test_the_part_ends_with_either_of_its_tasks(monkeypatch: pytest.MonkeyPatch, dying: str) -> None:
    """The gateway then reports the end. Otherwise the page would show an old view of the fleet forever."""

    async def go_on() -> None:
        await asyncio.Event().wait()

    async def fail() -> None:
        raise ZeroDivisionError

    path = ServerPath([])
    watch = FleetWatch(FleetView(path))
    monkeypatch.setattr(path, "keep", fail if dying == "path" else go_on)
    monkeypatch.setattr(watch, "run", fail if dying == "watch" else go_on)
    with pytest.raises(ZeroDivisionError):
        asyncio.run(FleetPart(path, watch).run())


class Looks(FleetView):
    """A view whose reads succeed until the test lets them fail."""

    failure: OSError | None = None

    async def look(self) -> None:
        if self.failure:
            raise self.failure


def test_an_old_view_makes_the_part_unhealthy() -> None:
    now = [0.0]
    view = Looks(ServerPath([]))
    watch = FleetWatch(view, lambda: now[0])
    part = FleetPart(ServerPath([]), watch)

    def health_after(seconds: float) -> str:
        now[0] += seconds
        return part.health()

    assert health_after(0) == "it was never read: the first read is in progress"
    view.failure = OSError("no server")
    asyncio.run(watch.look())
    assert health_after(0) == "it was never read: no server"
    view.failure = None
    asyncio.run(watch.look())
    assert health_after(5) == ""
    assert health_after(1) == "it was read 6 s ago: the first read is in progress"
    view.failure = OSError("no server")
    asyncio.run(watch.look())
    assert health_after(0) == "it was read 6 s ago: no server"
    assert watch.state()["age_s"] == 6.0


def test_a_password_in_an_address_is_never_shown() -> None:
    view = Looks(ServerPath([]))
    view.failure = OSError("no NATS server is reached at nats://anna:s3cret@a:4222, tls://t0ken@b:4222")
    watch = FleetWatch(view)
    asyncio.run(watch.look())
    assert watch.state()["trouble"] == "no NATS server is reached at nats://a:4222, tls://b:4222"


@pytest.mark.long
def test_the_page_shows_a_real_fleet_and_a_missing_one(fleet: Cluster, tmp_path: Path) -> None:
    urls = ", ".join(f'"{url}"' for url in fleet.urls)
    with served(tmp_path, f"[serve.fleet]\nnats = [{urls}]\n") as gateway:
        assert gateway.get("/api/plant").json["fleet"] is True
        told: dict[str, Any] = {}

        def is_seen() -> bool:
            told.update(gateway.get("/api/fleet").json)
            return told["age_s"] is not None and told["trouble"] is None

        until(is_seen)
        assert (told["gateways"], told["lines"], told["moves"]) == ({}, {}, [])
        until(lambda: gateway.get("/health").json["parts"] == {"fleet": "ok"})
    with served(tmp_path) as gateway:
        assert gateway.get("/api/plant").json["fleet"] is False
        answer = gateway.get("/api/fleet")
        assert (answer.status, answer.json["error"]) == (
            404,
            "this gateway shows no fleet; add [serve.fleet] to the plant file",
        )


@pytest.mark.long
def test_a_viewers_key_is_enough_to_show_the_fleet(tmp_path: Path) -> None:
    from secured_clusters import multidrop, secured_cluster

    plant = written(tmp_path, port="socket://127.0.0.1:4001")
    with secured_cluster(tmp_path / "nats", 1) as servers:
        made = multidrop(servers, "operator", "fleet", "init", str(plant.path))
        assert made.returncode == 0, made.stderr
        table = (
            f'nats = ["{servers.urls[0]}"]\ncredentials = "{servers.key("viewer")}"\nca = "{servers.tls.ca}"'
        )
        with served(tmp_path, f"[serve.fleet]\n{table}\n") as gateway:
            until(lambda: gateway.get("/api/fleet").json["lines"].keys() == {"hall"})
            until(lambda: gateway.get("/health").json["parts"] == {"fleet": "ok"})
        watched = multidrop(servers, "viewer", "fleet", "status", "--json")
        assert json.loads(watched.stdout)["lines"]["hall"]["master"] is None


@pytest.mark.long
@pytest.mark.parametrize("user", ["viewer", "commander"])
def test_the_page_stops_the_fleet_only_with_a_commanders_key(tmp_path: Path, user: str) -> None:
    from secured_clusters import secured_fleet

    with secured_fleet(tmp_path / "fleet", 1) as fleet:
        fleet.start("gw-1")
        fleet.wait_for_polling()
        servers = fleet.servers
        table = f'nats = ["{servers.urls[0]}"]\ncommander = "{servers.key(user)}"\nca = "{servers.tls.ca}"'
        may = '[serve.may]\nstop = "anyone"\n'
        with served(tmp_path, f"[serve.fleet]\n{table}\n{may}") as gateway:
            assert gateway.get("/api/plant").json["fleet_stop"] is True
            part: Any = gateway.gateway.feeds["fleet"]
            until(lambda: part._commands is not None)
            told = gateway.post("/api/fleet/stop", {}).json
    drives = {name: one["done"] for name, one in told.items()}
    if user == "viewer":
        assert drives == {"the fleet": False}
        assert "NOT sent" in told["the fleet"]["text"]
    else:
        assert len(drives) > 1
        assert set(drives.values()) == {True}, told


def test_the_page_cannot_stop_the_fleet_without_a_key_or_servers(tmp_path: Path) -> None:
    with served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway:
        assert gateway.get("/api/plant").json["fleet_stop"] is False
        answer = gateway.post("/api/fleet/stop", {})
        assert answer.status == 404
        assert "add commander to [serve.fleet]" in answer.json["error"]
    path: Any = ServerPath([])
    nobody: Any = object
    part = FleetPart(path, FleetWatch(Looks(path)), nobody)
    told = asyncio.run(part.stop("anna"))
    assert told == {
        "the fleet": (
            False,
            "the stop was NOT sent: no server of the fleet has answered yet; use the hard-wired stop",
        )
    }


@pytest.mark.slow
def test_missing_fleet_servers_are_reported_on_the_page(tmp_path: Path) -> None:
    [port] = free_ports(1)
    with served(tmp_path, f'[serve.fleet]\nnats = ["nats://127.0.0.1:{port}"]\n') as gateway:
        wanted = f"it was never read: no NATS server is reached at nats://127.0.0.1:{port}"
        until(lambda: wanted == gateway.get("/health").json["parts"]["fleet"])
        assert gateway.get("/api/fleet").json["age_s"] is None
        assert gateway.frame()["drives"]  # the gateway's own lines are still shown
