"""The OPC UA server of a gateway, used by asyncua's client."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import BoundProcess
from gateways import Served, served, written
from lines import PATIENCE, until

from multidrop import Plant, PlantError, PolledDrive
from multidrop.control.commands import MOST_STOPS
from multidrop.families import MODELS
from multidrop.families.registry import SHIPPED, find_model
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live import hub
from multidrop.gateway.opcua.part import SWITCH_S, USUAL_SWITCH_S, OpcUa, OpcUaSettings
from multidrop.gateway.settings import read_settings

try:
    from asyncua import ua
    from asyncua.sync import Client

    from multidrop.gateway.opcua.nodes import PlantNodes, fault_of, lasting, state_of, unit_of
except ImportError:
    if os.environ.get("CI"):
        raise
    pytest.skip("asyncua, the client, is not installed", allow_module_level=True)


SERVE = """[[line.drive.channel]]
name = "half"
value = "output_frequency / 2"
unit = "Hz"
[serve.opcua]
listen = "127.0.0.1:0"
[serve.may]
look = "anyone"
stop = "{stop}"
write = ["pump-1.setpoint", "pump-2.setpoint"]
verbs = ["pump-1.start", "pump-2.start"]
"""
SUBSCRIBER = Path(__file__).parents[2] / "support" / "programs" / "opcua_subscriber.py"
PLANT, PLANT_STOP = "ns=2;i=1", "ns=2;i=2"


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("opcua"), SERVE.format(stop="anyone")) as gateway:
        yield gateway


@pytest.fixture
def client(gateway: Served) -> Iterator[Any]:
    with Client(url_of(gateway), timeout=PATIENCE) as client:
        yield client


def url_of(gateway: Served) -> str:
    part: Any = gateway.gateway.feeds["opcua"]
    until(lambda: part.is_ready)
    return f"opc.tcp://127.0.0.1:{part.port}/"


@contextmanager
def logged_in(gateway: Served, right: Right) -> Iterator[Any]:
    client = Client(url_of(gateway), timeout=PATIENCE)
    client.set_user(next(one.name for one in gateway.gateway.settings.tokens if one.right is right))
    client.set_password(gateway.secrets[right])
    with client:
        yield client


def read(client: Any, node: str) -> Any:
    """Return the data value of a node, even if its status is bad."""
    return client.get_node(f"ns=2;s={node}").read_data_value(raise_on_bad_status=False)


def code(client: Any, node: str) -> str:
    return str(read(client, node).StatusCode.name)


def names_of(nodes: Any) -> list[str]:
    return [node.read_browse_name().Name for node in nodes]


def stop(client: Any, drive: str = "") -> str:
    """Call the stop of a drive, or of all drives; return the text of the answer."""
    place, method = (f"ns=2;s={drive}", f"ns=2;s={drive}.Stop") if drive else (PLANT, PLANT_STOP)
    return str(client.get_node(place).call_method(client.get_node(method).nodeid))


@pytest.mark.slow
async def test_an_opc_ua_server_accepts_no_client_if_closed_while_starting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A reload waits at most 3 s for the old server to end, so that server may still be starting."""
    from multidrop.gateway.opcua.server import PlantServer

    begun, may_start, start = threading.Event(), threading.Event(), PlantServer.start

    async def slow_start(server: PlantServer) -> None:
        begun.set()
        may_start.wait(PATIENCE)
        await start(server)

    monkeypatch.setattr(PlantServer, "start", slow_start)
    context: Any = SimpleNamespace(plant=Plant(()), version="1")
    part = OpcUa(OpcUaSettings("127.0.0.1:0"), context, None)
    running = asyncio.create_task(part.run())
    await asyncio.to_thread(begun.wait, PATIENCE)
    running.cancel()
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(part.close(), 0.1)
    may_start.set()
    assert part._serving is not None
    try:
        await asyncio.wait_for(asyncio.shield(part._serving), PATIENCE)
    finally:
        part._end_server()  # a server thread that still runs would keep the tests from ending


@pytest.mark.slow
async def test_closing_the_last_opc_ua_server_restores_thread_and_gc_settings(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The nodes are freed without a garbage collection."""
    serving, switch_s = {object()}, sys.getswitchinterval()
    monkeypatch.setattr("multidrop.gateway.opcua.part._unended", serving)
    context: Any = SimpleNamespace(plant=Plant(()), version="1", hub=SimpleNamespace(drives=[]))

    async def serve() -> None:
        part = OpcUa(OpcUaSettings("127.0.0.1:0"), context, None)
        running = asyncio.create_task(part.run())
        while not part.is_ready:
            await asyncio.sleep(0.05)
        running.cancel()
        await part.close()

    gc.unfreeze()
    gc.disable()
    try:
        await serve()
        assert gc.get_freeze_count() > 10_000
        assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
        serving.clear()
        before = gc.get_freeze_count()
        await serve()
        assert gc.get_freeze_count() == 0
        assert sys.getswitchinterval() == pytest.approx(USUAL_SWITCH_S)
        assert len(gc.get_objects()) < before + 50_000
    finally:
        gc.enable()
        gc.freeze()
        sys.setswitchinterval(switch_s)


@pytest.mark.slow
def test_opc_ua_nodes_are_excluded_from_garbage_collection(gateway: Served) -> None:
    """A garbage collection stops all threads; with the nodes, a full collection would take 0.2 s."""
    url_of(gateway)  # waits until the nodes of the drives exist
    assert gc.isenabled()
    assert gc.get_freeze_count() > 400_000
    assert sys.getswitchinterval() == pytest.approx(SWITCH_S)


@pytest.mark.slow
def test_each_drive_is_an_opc_ua_object_with_typed_values(client: Any) -> None:
    assert client.get_namespace_array()[2:] == ["urn:multidrop:plant"]
    plant = client.get_node("i=85").get_child("2:Plant")
    assert plant.nodeid.to_string() == PLANT
    assert names_of(plant.get_children()) == ["Stop", "pump-1", "pump-2"]
    pump = plant.get_child("2:pump-1")
    polled = ["status", "output_frequency", "output_current", "fault"]
    assert sorted(names_of(pump.get_children())) == sorted(["Stop", "State", "Fault", *polled])
    current = pump.get_child("2:output_current")
    assert current.read_type_definition().Identifier == ua.ObjectIds.AnalogUnitType
    assert current.read_data_type_as_variant_type() is ua.VariantType.Double
    unit = current.get_child("0:EngineeringUnits").read_value()
    assert (unit.DisplayName.Text, unit.UnitId) == ("A", 4279632)
    assert pump.get_child("2:status").read_data_type_as_variant_type() is ua.VariantType.String
    until(lambda: code(client, "pump-2.half") == "Good")  # `half` is a computed channel


@pytest.mark.slow
def test_opc_ua_values_have_the_time_of_their_request(gateway: Served, client: Any) -> None:
    until(lambda: code(client, "pump-1.output_frequency") == "Good")
    first = read(client, "pump-1.output_frequency")
    assert abs(first.SourceTimestamp.timestamp() - time.time()) < PATIENCE
    until(lambda: read(client, "pump-1.output_frequency").SourceTimestamp > first.SourceTimestamp)
    newest = gateway.gateway.hub.newest("pump-1", "output_frequency")
    assert newest is not None
    assert first.Value.Value == newest[2] == 0.0
    until(lambda: read(client, "pump-1.State").Value.Value == "stands")


@pytest.mark.slow
def test_values_of_a_silent_drive_have_the_status_bad_no_communication(gateway: Served, client: Any) -> None:
    gateway.sims["pump-2"].deaf_until = float("inf")
    try:
        until(lambda: code(client, "pump-2.output_frequency") == "BadNoCommunication")
        until(lambda: read(client, "pump-2.State").Value.Value == "silent")
        assert read(client, "pump-2.output_frequency").Value.Value is None
        until(lambda: code(client, "pump-2.Fault") == "BadNoCommunication")
        until(lambda: code(client, "pump-1.output_frequency") == "Good")
    finally:
        gateway.sims["pump-2"].deaf_until = 0.0
    until(lambda: code(client, "pump-2.output_frequency") == "Good")
    until(lambda: code(client, "pump-2.Fault") == "Good")


@pytest.mark.slow
def test_opc_ua_clients_cannot_write_values(client: Any) -> None:
    frequency = client.get_node("ns=2;s=pump-1.output_frequency")
    with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
        frequency.write_value(25.0)
    with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
        client.get_node(PLANT).add_object(2, "intruder")


@pytest.mark.slow
@pytest.mark.parametrize(("drive", "drives"), [("pump-1", ["pump-1"]), ("", ["pump-1", "pump-2"])])
def test_the_opc_ua_stop_method_stops_motors(
    gateway: Served, client: Any, drive: str, drives: list[str]
) -> None:
    gateway.start(*drives)
    assert "stop" in stop(client, drive)
    until(lambda: all(gateway.stands(one) for one in drives))
    until(lambda: all(read(client, f"{one}.State").Value.Value == "stands" for one in drives))


@pytest.mark.slow
def test_an_opc_ua_stop_called_on_a_wrong_object_stops_its_own_drive(
    gateway: Served, client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    gateway.start("pump-1", "pump-2")
    other, stop_1 = client.get_node("ns=2;s=pump-2"), client.get_node("ns=2;s=pump-1.Stop").nodeid
    with pytest.raises(ua.UaStatusCodeError, match="BadMethodInvalid"):
        other.call_method(stop_1)
    until(lambda: gateway.stands("pump-1"))
    assert not gateway.stands("pump-2")
    assert "stop" in stop(client, "")
    # With the limit 0, the server answers as if the limit of concurrent stops were reached.
    monkeypatch.setattr("multidrop.control.commands.MOST_STOPS", 0)
    stops = gateway.gateway.commands.stops
    earlier = stops["pump-1"]
    with pytest.raises(ua.UaStatusCodeError, match="BadMethodInvalid"):
        other.call_method(stop_1)
    until(lambda: stops["pump-1"] == earlier + 1)
    assert stop(client, "pump-1") == "the stop is in progress"
    until(lambda: stops["pump-1"] == earlier + 2)


@pytest.mark.slow
def test_opc_ua_stop_calls_in_one_request_do_not_wait_for_each_other(gateway: Served, client: Any) -> None:
    gateway.start("pump-1")
    gateway.sims["pump-2"].deaf_until = float("inf")
    try:
        calls = [
            ua.CallMethodRequest(*(client.get_node(f"ns=2;s={name}").nodeid for name in (one, f"{one}.Stop")))
            for one in ("pump-2", "pump-1")
        ]
        session = client.aio_obj.uaclient
        found = client.tloop.post(session.call(calls))
        assert found[0].StatusCode.name == "GoodCompletesAsynchronously"
        assert found[0].OutputArguments[0].Value == "the stop is in progress"
        assert gateway.stands("pump-1")
    finally:
        gateway.sims["pump-2"].deaf_until = 0.0
    until(lambda: not gateway.gateway.bus("hall").stops_under_way())


YARD = """
[[line]]
name = "yard"
port = "{port}"
[[line.drive]]
name = "fan-1"
model = "invt-che"
address = 1
"""


@pytest.mark.slow
def test_a_stop_of_all_drives_is_sent_while_many_earlier_stops_wait(tmp_path: Path) -> None:
    silent, port = os.openpty()
    try:
        with (
            served(tmp_path, SERVE.format(stop="anyone") + YARD.format(port=os.ttyname(port))) as gateway,
            Client(url_of(gateway), timeout=PATIENCE) as client,
        ):
            for _ in range(MOST_STOPS):
                assert stop(client) == "the stop is in progress"
            gateway.start("pump-1")
            assert stop(client) == "the stop is in progress"
            until(lambda: gateway.stands("pump-1"))
    finally:
        os.close(silent)
        os.close(port)


@pytest.mark.slow
def test_a_hanging_opc_ua_client_delays_neither_polling_nor_stops(gateway: Served, client: Any) -> None:
    words = [sys.executable, str(SUBSCRIBER), url_of(gateway), "50"]
    gateway.start("pump-1", "pump-2")
    with BoundProcess(words, stdout=subprocess.PIPE, text=True) as subscriber:
        assert subscriber.stdout is not None
        assert subscriber.stdout.readline()
        subscriber.send_signal(signal.SIGSTOP)
        rows = gateway.gateway.hub.taken
        until(lambda: gateway.gateway.hub.taken > rows + 20)
        assert "stop" in stop(client, "pump-1")
        until(lambda: gateway.stands("pump-1"))
        assert gateway.post("/api/stop").json["pump-2"]["done"] is True
        subscriber.kill()


@pytest.mark.slow
def test_opc_ua_clients_have_the_rights_of_their_tokens(tmp_path: Path) -> None:
    with served(tmp_path, SERVE.format(stop="token")) as gateway:
        with Client(url_of(gateway), timeout=PATIENCE) as anyone, logged_in(gateway, Right.LOOK) as viewer:
            for client in (anyone, viewer):
                with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                    stop(client)
        wrong = Client(url_of(gateway), timeout=PATIENCE)
        wrong.set_user("anna")
        wrong.set_password("wrong")
        with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
            wrong.connect()
        wrong.disconnect()
        with logged_in(gateway, Right.STOP) as stopper:
            assert "stop" in stop(stopper)
            gateway.gateway.tokens.replace([])  # removes the tokens, as a reload can do
            gateway.gateway.commands.may = gateway.gateway.commands.may._replace(look="token")
            with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                read(stopper, "pump-1.State")


@pytest.mark.slow
def test_an_opc_ua_client_with_a_wrong_token_can_stop_but_not_read(gateway: Served) -> None:
    """The setting stop = "anyone" applies to this client as to clients without a token."""
    client = Client(url_of(gateway), timeout=PATIENCE)
    client.set_user("anna")
    client.set_password("revoked")
    with client:
        gateway.start("pump-1")
        assert "stop" in stop(client, "pump-1")
        until(lambda: gateway.stands("pump-1"))
        with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
            read(client, "pump-1.State")


@pytest.mark.slow
def test_a_reload_removes_and_adds_opc_ua_objects_of_drives(tmp_path: Path) -> None:
    class Notes:
        codes: list[str] = []

        def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
            self.codes.append(data.monitored_item.Value.StatusCode.name)

    with (
        served(tmp_path, SERVE.format(stop="anyone")) as gateway,
        Client(url_of(gateway), timeout=PATIENCE) as client,
    ):
        until(lambda: code(client, "pump-2.output_frequency") == "Good")
        subscription = client.create_subscription(50, Notes())
        subscription.subscribe_data_change(client.get_node("ns=2;s=pump-2.output_frequency"))
        path = tmp_path / "plant.toml"
        path.write_text(path.read_text().replace('"pump-2', '"fan'))
        assert gateway.reload()["done"] is True
        until(lambda: code(client, "fan.output_frequency") == "Good")
        assert code(client, "pump-2.output_frequency") == "BadNodeIdUnknown"
        until(lambda: Notes.codes[-1:] == ["BadNodeIdUnknown"])
        assert names_of(client.get_node(PLANT).get_children()) == ["Stop", "pump-1", "fan"]


class Cyclic:
    """An object that refers to itself, as the node of a drive does."""

    def __init__(self) -> None:
        self.own = self


@pytest.mark.long
async def test_memory_of_opc_ua_nodes_is_freed_when_drives_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def remove(nodes: PlantNodes, name: str) -> None:
        del nodes._drives[name]

    async def add(nodes: PlantNodes, name: str, polled: PolledDrive) -> None:
        nodes._drives[name] = SimpleNamespace(polled=polled)  # type: ignore[assignment]

    monkeypatch.setattr(PlantNodes, "_remove", remove)
    monkeypatch.setattr(PlantNodes, "_add_drive", add)
    monkeypatch.setattr("multidrop.gateway.opcua.nodes.MOST_REMOVED", 2)
    server: Any = SimpleNamespace(isession=None, aspace=None)
    nodes, plants = PlantNodes(server), cycle(("pump", "fan"))
    with lasting():
        left = weakref.ref(Cyclic())
    freed = []
    for _ in range(4):
        await nodes.adopt(written(tmp_path, "", next(plants)))
        gc.collect()
        freed.append(left() is None)
    assert freed == [False, False, False, True]


# ---- the table `[serve.opcua]`: addresses, protection of connections from other machines, names ----


OPEN = "is open to other machines: that needs certificate and key here and tokens in [serve]"

CHANNEL = '[[line.drive.channel]]\nname = "{}"\nvalue = "output_frequency / 2"\nunit = "Hz"'


@pytest.mark.parametrize(
    ("serve", "drives", "sentence"),
    [
        ('listen = "4840"', (), 'not an address and port; write listen = "127.0.0.1:4840"'),
        ('listen = "0.0.0.0:4840"', (), OPEN),
        ('listen = "0.0.0.0:4840"\ncertificate = "plant.toml"\nkey = "plant.toml"', (), OPEN),
        ('certificate = "cert.pem"', (), "certificate and key belong together: give both keys, or neither"),
        ('certificate = "cert.pem"\nkey = "plant.toml"', (), 'certificate = "cert.pem": there is no file'),
        ("port = 4840", (), "unknown key 'port'"),
        ("", ("a", "a.status"), 'drive "a.status" has the node id of a value of "a": choose another name'),
        ("", ("a", "a.Stop.OutputArguments"), 'drive "a.Stop.OutputArguments" has the node id of a value of'),
        (CHANNEL.format("State"), ("a",), 'channel "State" of "a" has the node id of another value'),
        (CHANNEL.format("half"), ("a.half", "a"), 'drive "a.half" has the node id of a value of "a"'),
    ],
)
def test_mistakes_in_the_opc_ua_settings_are_reported(
    tmp_path: Path, serve: str, drives: tuple[str, ...], sentence: str
) -> None:
    with pytest.raises(PlantError) as mistakes:
        read_settings(written(tmp_path, f"[serve.opcua]\n{serve}\n", *drives), {})
    assert sentence in str(mistakes.value)


def test_opc_ua_accepts_only_clients_on_this_computer_by_default(tmp_path: Path) -> None:
    settings = read_settings(written(tmp_path, "[serve.opcua]\n"), {})
    assert settings.parts["opcua"] == OpcUaSettings("127.0.0.1:4840")


GOOD_ROW, MISS = (5, 50, 24.5, 0), (7, 70, 0.0, 1)
NAMES = {  # names of OPC UA status codes (OPC 10000-6, A.2, StatusCode.csv)
    0x00000000: "Good",
    0x40900000: "Uncertain_LastUsableValue",
    0x408F0000: "Uncertain_NoCommunicationLastUsableValue",
    0x80000000: "Bad",
    0x80310000: "Bad_NoCommunication",
    0x80050000: "Bad_CommunicationError",
    0x808B0000: "Bad_DeviceFailure",
    0x808C0000: "Bad_SensorFailure",
    0x80320000: "Bad_WaitingForInitialData",
}


@pytest.mark.parametrize(
    ("newest", "good", "is_current", "reason", "expected"),
    [
        (None, None, False, "", ("Bad_WaitingForInitialData", None, 0)),
        (GOOD_ROW, GOOD_ROW, True, "ok", ("Good", 24.5, 5)),
        (GOOD_ROW, GOOD_ROW, False, "ok", ("Uncertain_LastUsableValue", 24.5, 5)),
        (MISS, GOOD_ROW, True, "no reply", ("Uncertain_NoCommunicationLastUsableValue", 24.5, 5)),
        (MISS, GOOD_ROW, False, "no reply", ("Bad_NoCommunication", None, 7)),
        (MISS, None, False, "not asked: drive is silent", ("Bad_NoCommunication", None, 7)),
        (MISS, None, False, "port lost", ("Bad_NoCommunication", None, 7)),
        (MISS, None, False, "bad checksum", ("Bad_CommunicationError", None, 7)),
        (MISS, None, False, "exception 02", ("Bad_DeviceFailure", None, 7)),
        (MISS, None, False, "no valid value", ("Bad_SensorFailure", None, 7)),
    ],
)
def test_each_row_has_the_expected_opc_ua_status_code(
    newest: tuple[int, int, float, int] | None,
    good: tuple[int, int, float, int] | None,
    is_current: bool,
    reason: str,
    expected: tuple[str, float | None, int],
) -> None:
    state = state_of("pump-1", "load", newest, good, is_current, reason)
    assert (NAMES[state.code], state.value, state.time_ns) == expected


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (hub.Shown(hub.FAULT, "overcurrent"), ("Good", "overcurrent")),
        (hub.Shown(hub.RUNS, None), ("Good", "")),
        (hub.Shown(hub.UNKNOWN, None), ("Good", "")),
        (hub.Shown(hub.UNKNOWN, hub.INCOMPLETE), ("Bad", None)),
        (hub.Shown(hub.UNKNOWN, hub.NOT_ASKED), ("Bad", None)),
        (hub.Shown(hub.SILENT, "no reply"), ("Bad_NoCommunication", None)),
    ],
)
def test_the_opc_ua_fault_text_is_bad_if_the_fault_state_is_unknown(
    shown: hub.Shown, expected: tuple[str, str | None]
) -> None:
    code, text = fault_of(shown)
    assert (NAMES[code], text) == expected


@pytest.mark.parametrize(  # ids from the OPC Foundation's list UNECE_to_OPCUA.csv
    ("unit", "number"),
    [("Hz", 4740186), ("V", 5655636), ("A", 4279632), ("%", 20529), ("kW", 4937556), ("°C", 4408652)],
)
def test_a_unit_of_measurement_has_its_unece_id(unit: str, number: int) -> None:
    found = unit_of(unit)
    assert (found.UnitId, found.DisplayName.Text) == (number, unit)


def test_each_unit_of_measurement_of_a_family_has_a_unece_id() -> None:
    families = map(find_model, (*MODELS, *SHIPPED))
    units = {register.unit for family in families for register in family.registers.values() if register.unit}
    assert len(units) > 10
    assert {unit for unit in units if unit_of(unit).UnitId == -1} == set()
