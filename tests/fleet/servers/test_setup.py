"""`fleet init` on real servers: which buckets it creates, and which servers it refuses."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import BoundProcess
from fleets import MemoryBucket
from free_ports import free_ports
from nats_clusters import (
    Cluster,
    cluster,
    connected_path,
    initialised,
    old_server_program,
    opened_paths,
    server_program,
)
from tables import table

from multidrop import Plant
from multidrop.fleet.errors import FleetError, OutcomeUnknown
from multidrop.fleet.servers import connections as servers
from multidrop.fleet.servers import names, setup
from multidrop.fleet.servers.batch_client import DirectMessage
from multidrop.fleet.servers.buckets import LeaseBucket, Record, ask
from multidrop.fleet.servers.connections import ServerPath, paths_of
from multidrop.fleet.servers.leaders import have_leaders
from multidrop.fleet.servers.plant_store import line_of, read_plant, store


@pytest.mark.slow
def test_buckets_are_created_on_all_three_servers(nats: Cluster) -> None:
    made = asyncio.run(initialised(nats.urls))
    assert made["replicas"] == 3
    assert set(made["servers"]) == {"n1", "n2", "n3"}
    assert asyncio.run(initialised(nats.urls)) == made  # a second run changes no bucket


@pytest.mark.slow
async def test_connections_and_bucket_leaders_are_spread_over_all_servers(fleet: Cluster) -> None:
    async with opened_paths(fleet.urls) as paths:
        assert [path.server_name for path in paths] == ["n1", "n2", "n3"]
        ends = time.monotonic() + 20
        while True:
            await setup.bring_leaders_home(paths[0], await setup.led_clusters(paths[0]))
            infos = [await ask(paths[0], f"STREAM.INFO.KV_lease_{at}") for at in range(3)]
            leaders = [info["cluster"].get("leader") for info in infos]
            if leaders == ["n1", "n2", "n3"]:
                break
            assert time.monotonic() < ends, leaders
            await asyncio.sleep(0.2)


class Deaf:
    """A server connection on which the leaders of some ownership buckets give the answer `said`, or none."""

    server_name = "n1"

    def __init__(self, said: bytes | None, *buckets: str) -> None:
        self.said = said
        self.buckets = buckets

    async def request(self, subject: str, data: bytes, answer_s: float) -> SimpleNamespace:
        if not subject.endswith(self.buckets):
            return SimpleNamespace(data=b'{"cluster":{"leader":"n1"}}')
        if self.said is None:
            raise OutcomeUnknown("no answer")
        return SimpleNamespace(data=self.said)


@table(
    ("said", "has"),
    [(b'{"cluster":{"leader":"n2"}}', True), (b"{}", True), (b'{"cluster":{}}', False), (None, False)],
)
def test_two_buckets_need_leaders_before_lines_can_be_claimed(said: bytes | None, has: bool) -> None:
    for bucket in names.OWNERS:
        one: Any = Deaf(said, bucket)
        assert asyncio.run(have_leaders(one))
        two: Any = Deaf(said, *(other for other in names.OWNERS if other != bucket))
        assert asyncio.run(have_leaders(two)) is has


@pytest.mark.slow
def test_init_refuses_old_servers_that_accept_two_writes_to_one_revision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Old servers accept two concurrent writes to one revision. Their version is not checked in this test."""
    monkeypatch.setattr(servers, "OLDEST", (0, 0))
    with cluster(tmp_path, 3, old_server_program()) as old:
        sentence = r"same revision of a record\. Such servers could give one lease to two gateways"
        with pytest.raises(FleetError, match=sentence):
            asyncio.run(initialised(old.urls))


def test_init_refuses_servers_that_accept_concurrent_lease_writes(
    nats: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such servers would grant a lease to two gateways. Some of their answers may arrive too late."""
    monkeypatch.setattr(LeaseBucket, "_pattern", LeaseBucket._subject)
    with pytest.raises(FleetError, match=r"accepted [2-6] of 6 concurrent writes to the same revision"):
        asyncio.run(initialised(nats.urls))


@pytest.mark.slow
@table(("is_carried_out",), [(True,), (False,)])
def test_init_retries_the_removal_of_the_test_bucket(
    is_carried_out: bool, nats: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`init` removes the bucket of its test. A busy leader may answer too late."""
    removals = []

    async def ask_in_vain(path: ServerPath, subject: str, data: Any = None) -> dict[str, Any]:
        if subject.startswith("STREAM.DELETE"):
            removals.append(subject)
            if len(removals) == 1:
                if is_carried_out:
                    await ask(path, subject, data)
                raise OutcomeUnknown("no answer")
        return await ask(path, subject, data)

    monkeypatch.setattr(setup, "ask", ask_in_vain)
    asyncio.run(initialised(nats.urls))
    assert removals == ["STREAM.DELETE.KV_contest"] * (1 if is_carried_out else 2)


@pytest.mark.long
@pytest.mark.slow
def test_init_needs_all_servers_only_when_it_creates_buckets(tmp_path: Path) -> None:
    """A bucket stored on only two servers would fail with either server."""
    with cluster(tmp_path, 3) as three:
        down = next(node for node in three.nodes if not node.leads_servers())
        others = [node for node in three.nodes if node is not down]
        down.kill()
        with pytest.raises(FleetError, match=f"^the NATS server {down.url} does not answer, and would"):
            asyncio.run(initialised(three.urls))
        down.start()
        three.wait()
        assert asyncio.run(initialised(three.urls))["replicas"] == 3
        down.kill()
        ends = time.monotonic() + 60
        while not {f"KV_{name}" for name in names.BUCKETS} <= set().union(*(one.leads() for one in others)):
            assert time.monotonic() < ends
            time.sleep(0.1)
        # no bucket is missing, so two of three servers are enough
        assert asyncio.run(initialised(three.urls))["replicas"] == 3


@pytest.mark.long
@pytest.mark.slow
def test_servers_without_a_quorum_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(setup, "WAIT_S", 1.0)
    with cluster(tmp_path, 3) as three:
        for node in three.nodes[1:]:
            node.kill()
        with pytest.raises(FleetError, match="have no quorum: more than half of them must run"):
            asyncio.run(initialised(three.urls[:1]))


NO_LEADER = (
    b'{"error":{"code":503,"err_code":10008,"description":"JetStream system temporarily unavailable"}}'
)


@pytest.mark.slow
def test_init_reports_a_missing_quorum_if_jetstream_is_unavailable(
    nats: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(setup, "WAIT_S", 0.5)

    async def refuse(self: ServerPath, subject: str, *rest: object, **more: object) -> SimpleNamespace:
        return SimpleNamespace(data=NO_LEADER)

    monkeypatch.setattr(ServerPath, "request", refuse)
    with pytest.raises(FleetError, match=r"have no quorum: .* \(nats:.* says: JetStream system temporarily"):
        asyncio.run(initialised(nats.urls))


@pytest.mark.slow
def test_init_waits_until_a_new_plant_can_be_read(nats: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """Servers may refuse to read from a bucket that was created a moment ago."""
    collect, failures = ServerPath.collect, [OutcomeUnknown("it ended with 503")] * 2

    async def fail_at_first(self: ServerPath, subject: str, data: bytes) -> list[DirectMessage]:
        if failures:
            raise failures.pop()
        return await collect(self, subject, data)

    monkeypatch.setattr(ServerPath, "collect", fail_at_first)
    assert asyncio.run(initialised(nats.urls))["replicas"] == 3
    assert failures == []


@pytest.mark.slow
def test_a_server_without_jetstream_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(setup, "WAIT_S", 0.5)
    [port] = free_ports(1)
    command = [server_program(), "-a", "127.0.0.1", "-p", str(port)]
    with (tmp_path / "log").open("wb") as log, BoundProcess(command, stdout=log, stderr=log) as server:
        ends = time.monotonic() + 60
        while b"Server is ready" not in (tmp_path / "log").read_bytes():
            assert time.monotonic() < ends
            time.sleep(0.02)
        with pytest.raises(FleetError, match=r"no JetStream answers at nats:.* needs `jetstream"):
            asyncio.run(initialised([f"nats://127.0.0.1:{port}"]))
        server.kill()


@pytest.mark.slow
def test_a_bucket_without_a_leader_has_no_quorum(fleet: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last running server of a cluster answers for some seconds, but names no leader in its answers."""
    told = setup.ask

    async def without_leader(path: ServerPath, subject: str) -> dict[str, Any]:
        info = await told(path, subject)
        info["cluster"].pop("leader", None)
        return info

    monkeypatch.setattr(setup, "ask", without_leader)
    monkeypatch.setattr(setup, "WAIT_S", 0.2)
    with pytest.raises(FleetError, match=r"have no quorum: .*the bucket lease_0 has no leader"):
        asyncio.run(_check(fleet))


@pytest.mark.slow
def test_init_waits_for_the_election_of_a_leader(fleet: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """Most servers run, but the bucket's leader has died, and the election of the next one takes a moment."""
    told, silent = setup.ask, ["STREAM.INFO.KV_lease_1"] * 3

    async def silent_at_first(path: ServerPath, subject: str) -> dict[str, Any]:
        if subject in silent:
            silent.remove(subject)
            raise OutcomeUnknown("no answer")
        return await told(path, subject)

    monkeypatch.setattr(setup, "ask", silent_at_first)
    asyncio.run(_check(fleet))
    assert silent == []


@pytest.mark.long
@pytest.mark.parametrize(("ahead_s", "words"), [(3600, "is 3600 s ahead of"), (-3600, "is 3600 s behind")])
def test_init_warns_if_this_computers_clock_differs_from_the_servers(
    fleet: Cluster,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    ahead_s: float,
    words: str,
) -> None:
    asyncio.run(_check(fleet))
    assert caplog.messages == []
    real = time.time
    monkeypatch.setattr(setup.time, "time", lambda: real() + ahead_s)
    asyncio.run(_check(fleet))
    [said] = caplog.messages
    assert words in said
    assert said.endswith("set it, because samples get its time")


async def _check(fleet: Cluster) -> None:
    async with connected_path(fleet) as path:
        await setup.check_buckets(path)


@pytest.mark.long
async def test_connection_returns_to_the_preferred_server_after_an_outage(tmp_path: Path) -> None:
    with cluster(tmp_path, 3) as three:
        path = paths_of(three.urls)[1]
        await path.open()
        assert path.server_name == "n2"
        three.nodes[1].pause()
        await path.check()
        assert path.server_name == "n3"
        three.nodes[1].go_on()
        await path.check()
        assert path.server_name == "n2"
        three.nodes[1].kill()
        while path.is_open:
            await asyncio.sleep(0.01)
        await path.check()
        assert path.server_name == "n3"
        await path.close()


@pytest.mark.long
async def test_connection_uses_another_server_if_the_preferred_one_is_silent(tmp_path: Path) -> None:
    with cluster(tmp_path, 2) as two:
        two.nodes[0].pause()

        async with connected_path(two) as path:
            assert path.server_name == "n2"


# ---- a plant in the bucket: each line read from its record equals that line of the plant file ----


PLANT = r"""
[[line]]
name = "hall-1"
port = "socket://10.0.0.7:4001"
baudrate = 19200
format = "8E1"
switching = "2 ms"
[[line.drive]]
name = "pump \"1\" \\ Größe æ"
model = "innovert-ibd"
address = 1
every = "50 ms"
poll = ["output_current", {register = "motor_speed", every = "1 s"}]
[[line.drive]]
name = "fan"
model = "innovert-ibd"
address = 2
maximum_frequency = 87.5
[[line]]
name = "hall-2"
port = "tcp://10.0.0.8:502"
[[line.drive]]
name = "other"
model = "invt-che"
address = 3
"""


def lines_again(path: Path, folder: Path) -> list[Any]:
    """Return the lines of a plant file as another computer reads them from JSON records."""
    _, records = read_plant(path)
    shipped: dict[str, Any] = json.loads(json.dumps(records))
    return [line_of(Record(name, 7, value), folder) for name, value in shipped.items()]


def as_text(line: Any) -> str:
    return repr(
        [line.name, line.port, line.baudrate, line.format, line.switching, line.echo, line.transaction]
    ) + repr(
        [
            (
                polled.drive.name,
                polled.drive.address,
                type(polled.drive).__name__,
                vars(polled.drive.settings)
                if hasattr(polled.drive.settings, "__dict__")
                else polled.drive.settings,
                [(poll.register.name, poll.every) for poll in polled.polls],
            )
            for polled in line.drives
        ]
    )


def test_stored_line_records_give_the_same_lines_as_the_plant_file(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT, "utf-8")
    again = lines_again(path, tmp_path / "gateway")
    assert [as_text(line) for line in again] == [as_text(line) for line in Plant.load(path).lines]


def test_a_family_file_is_stored_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "families").mkdir()
    head = '[family]\ntitle = "Meter"\nmanual = "M"\ncounts_from = 0\n'
    (tmp_path / "families" / "own.toml").write_text(f'{head}[reading]\nvoltage = {{ at = 3, unit = "V" }}\n')
    path = tmp_path / "plant.toml"
    path.write_text(
        '[[line]]\nname = "hall"\nport = "socket://h:1"\n[[line.drive]]\nname = "meter"\n'
        'model = "families/own.toml"\naddress = 1\n'
    )
    [again] = lines_again(path, tmp_path / "gateway")
    assert as_text(again) == as_text(Plant.load(path).lines[0])
    assert (tmp_path / "gateway" / "hall" / "families" / "own.toml").exists()


@pytest.mark.parametrize("name", ["../escape.toml", "/escape.toml", "a/../../b.toml"])
def test_a_line_record_cannot_write_a_file_outside_the_lines_folder(tmp_path: Path, name: str) -> None:
    value = {"line": {"name": "hall"}, "files": {name: "text"}}
    with pytest.raises(ValueError, match="outside the line's folder"):
        line_of(Record("hall", 1, value), tmp_path / "gateway")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("model", ["own.py:Own", "own.py"])
def test_a_gateway_does_not_run_a_python_file_from_a_line_record(tmp_path: Path, model: str) -> None:
    ran = tmp_path / "ran"
    drive = {"name": "pump", "model": model, "address": 1}
    line = {"name": "hall", "port": "tcp://127.0.0.1:502", "drive": [drive]}
    files = {"own.py": f"open({str(ran)!r}, 'w')\n"}
    with pytest.raises(ValueError, match="which gateways of a fleet do not run"):
        line_of(Record("hall", 1, {"line": line, "files": files}), tmp_path / "gateway")
    assert not ran.exists()


async def test_storing_a_plant_again_keeps_the_revision_of_unchanged_lines() -> None:
    memory = MemoryBucket("plant")
    bucket: Any = memory
    first = {name: {"line": {"name": name}, "files": {}} for name in ("a", "b", "c")}
    assert await store(bucket, first) == {"new": 3, "changed": 0, "removed": 0, "kept": 0}
    before = {name: memory.revision(name) for name in first}
    second = {**first, "b": {"line": {"name": "b", "port": "x"}, "files": {}}}
    del second["c"]
    assert await store(bucket, second) == {"new": 0, "changed": 1, "removed": 1, "kept": 1}
    assert memory.revision("a") == before["a"]
    assert memory.records["c"].value is None
    assert await store(bucket, first) == {"new": 1, "changed": 1, "removed": 0, "kept": 1}


async def test_two_fleet_init_commands_at_the_same_time_are_reported() -> None:
    bucket = MemoryBucket(names.PLANT)
    bucket.before_put = lambda key: bucket.store(key, {"line": {"name": key}, "files": {}})
    with pytest.raises(FleetError, match=r"line hall-1 has changed in the meantime: run `multidrop fleet"):
        await store(bucket, {"hall-1": {"line": {"name": "hall-1", "port": "socket://a:1"}, "files": {}}})


def test_a_line_record_has_only_the_permissions_of_its_own_drives(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT)
    _, before = read_plant(path)
    lists = 'write = ["fan.frequency"]\nverbs = ["other.start", "fan.start", "other.reset_fault"]'
    path.write_text(f"{PLANT}\n[fleet.may]\n{lists}\n")
    plant, records = read_plant(path)
    assert len(plant.lines) == 2
    assert records["hall-1"]["may"] == {"write": ["fan.frequency"], "verbs": ["fan.start"]}
    assert records["hall-2"]["may"] == {"verbs": ["other.reset_fault", "other.start"]}
    assert all("may" not in record for record in before.values())
    path.write_text(f'{PLANT}\n[fleet.may]\nverbs = ["other.start"]\n')
    # the record is unchanged, so the line is polled without a break
    assert read_plant(path)[1]["hall-1"] == before["hall-1"]


CHANNEL = '[[line.drive.channel]]\nname = "half"\nvalue = "{} / 2"\nunit = "{}"\n'


def test_computed_channels_of_a_line_are_stored_with_its_description(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT + CHANNEL.format("output_frequency", "Hz"))
    *_, last = lines_again(path, tmp_path / "copy")
    assert last.drives[0].channels == Plant.load(path).lines[1].drives[0].channels != ()


def test_a_channel_that_uses_drives_of_several_lines_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT + CHANNEL.format("fan.output_current", "A"))
    assert Plant.load(path)
    with pytest.raises(ValueError, match="in a fleet, a channel may only use drives of its own line"):
        read_plant(path)
