"""Many requests under way at once, of several clients with the same ids: each answer is its request's own."""

from __future__ import annotations

import asyncio
import random
import threading
from collections.abc import Iterator

import pytest
from modbus_gateway import FakeLine, Gateway, RawClient, RawReply, plant_of, request, serving

from multidrop import Drive, reading
from multidrop.gateway.modbus_server.settings import ModbusSettings

POLLED, PASSED = 500, 40  # addresses of each drive
CLIENTS = 3
WINDOW = 200  # requests of a client that are sent before their answers are read


class Ramp(Drive):
    """A device whose every register holds a number of its own."""


Wide = type(
    "Wide",
    (Ramp,),
    {f"level_{at}": reading(at) for at in range(POLLED + PASSED)},
)


def value(unit: int, address: int) -> int:
    """The number in a register: two units differ everywhere."""
    return (7919 * address + 20011 * unit) % 0x10000


class SlowLine(FakeLine):
    """Answers with the registers' numbers, some of them after others that came later."""

    async def ask(self, drive: str, function: int, start: int, count: int, expiry: float) -> list[int]:
        await asyncio.sleep(0.001 * (start % 5))
        return [value(int(drive), start + at) for at in range(count)]


@pytest.fixture
def gateway(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gateway]:
    monkeypatch.setattr("modbus_gateway.FakeLine", SlowLine)
    units = range(1, CLIENTS + 1)
    plant = plant_of(*((f"line-{unit}", Wide(unit, name=str(unit))) for unit in units))
    with serving(plant, ModbusSettings(listen="127.0.0.1:0", passing="any")) as found:
        for unit in units:
            for address in range(POLLED):
                found.hub.values[str(unit), f"level_{address}"] = float(value(unit, address))
        yield found


def expected(unit: int, start: int, count: int) -> list[int]:
    return [value(unit, start + at) for at in range(count)]


def drawn(chance: random.Random) -> tuple[int, int]:
    """A range that is in the cache, or one in fifty that is not."""
    if chance.random() < 0.02:
        return POLLED + chance.randrange(PASSED - 4), chance.randint(1, 4)
    return chance.randrange(POLLED - 4), chance.randint(1, 4)


def pipeline(client: RawClient, unit: int, requests: int) -> int:
    """Send windows of requests and match each reply with its own; return how many were passed on."""
    chance = random.Random(unit)
    passed = 0
    for first in range(0, requests, WINDOW):
        asked = {(first + at) % 0x10000: drawn(chance) for at in range(WINDOW)}
        client.send(b"".join(request(number, unit, 3, *where) for number, where in asked.items()))
        for _ in range(WINDOW):
            reply = client.receive()
            assert isinstance(reply, RawReply)
            start, count = asked.pop(reply.transaction)
            assert reply.unit == unit
            if start >= POLLED and reply.code == 6:
                continue  # the line's share is used up
            assert (reply.function, reply.words) == (3, expected(unit, start, count))
            passed += start >= POLLED
        assert asked == {}
    return passed


def all_clients(gateway: Gateway, requests: int) -> None:
    """Let clients pipeline beside each other, each to a unit of its own, and under the same ids."""
    failures: list[BaseException] = []
    passed: list[int] = []

    def run(unit: int) -> None:
        try:
            with gateway.client() as client:
                passed.append(pipeline(client, unit, requests // CLIENTS))
        except BaseException as failure:
            failures.append(failure)

    threads = [threading.Thread(target=run, args=(unit,)) for unit in range(1, CLIENTS + 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    assert sum(passed) > 10  # answers came out of order too


@pytest.mark.long
def test_thousands_of_requests_are_answered_under_their_own_ids(gateway: Gateway) -> None:
    all_clients(gateway, 8_000)


@pytest.mark.long
def test_a_million_requests_are_answered_under_their_own_ids(gateway: Gateway) -> None:
    all_clients(gateway, 1_000_000)


@pytest.mark.long
def test_a_reader_that_is_slower_than_its_requests_gets_all_answers(gateway: Gateway) -> None:
    """All is sent before anything is read: what is asked waits while the answers before are not taken."""
    requests = 20_000
    with gateway.client() as client:
        frames = b"".join(request(number, 1, 3, 0, 120) for number in range(requests))
        sender = threading.Thread(target=client.send, args=(frames,))
        sender.start()
        with gateway.client() as other:  # meanwhile
            for _ in range(50):
                assert other.ask(2, 3, 1, 1).words == expected(2, 1, 1)
        for number in range(requests):
            reply = client.receive()
            assert reply is not None
            assert (reply.transaction, reply.words) == (number, expected(1, 0, 120))
        sender.join()
