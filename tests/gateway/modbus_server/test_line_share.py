"""The share of a line's time that Modbus clients may use: measured, limited, and divided fairly."""

from __future__ import annotations

import asyncio

import pytest
from controlled_loop import run_controlled as run_test  # noqa: F401 (the event loop of all tests here)
from examples import usually

from multidrop.gateway.modbus_server.line_share import (
    BURST_S,
    EXPIRY_S,
    MOST_WAITING,
    SHARE,
    LineShare,
    PassingBusy,
)


class PacedLine:
    """A line whose requests take `seconds` each; records their start times and how many overlapped."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.under_way = self.most = 0
        self.begun: list[float] = []
        self.left: list[float] = []

    async def ask(self, left: float) -> list[int]:
        self.begun.append(asyncio.get_running_loop().time())
        self.left.append(left)
        self.under_way += 1
        self.most = max(self.most, self.under_way)
        await asyncio.sleep(self.seconds)
        self.under_way -= 1
        return [len(self.begun)]


async def flood(share: LineShare, line: PacedLine, seconds: float, clients: int = 3) -> int:
    """Send requests without pause for `seconds`; return how many were answered."""
    loop = asyncio.get_running_loop()
    until = loop.time() + seconds
    answered = 0

    async def client(name: object) -> None:
        nonlocal answered
        while loop.time() < until:
            try:
                await share.ask(name, line.ask)
                answered += 1
            except PassingBusy:
                await asyncio.sleep(0.01)

    await asyncio.gather(*(client(f"client {number % clients}") for number in range(clients * 4)))
    return answered


@pytest.mark.long
@pytest.mark.parametrize("seconds", usually(0.03, 0.005, 0.7))
async def test_a_flood_gets_exactly_a_fifth_of_the_line_s_time(seconds: float) -> None:
    loop = asyncio.get_running_loop()
    begun = loop.time()
    share, line = LineShare(), PacedLine(seconds)
    await flood(share, line, 60.0)
    passed = loop.time() - begun
    used = seconds * len(line.begun)
    assert used <= SHARE * passed + BURST_S + seconds
    assert used >= SHARE * 60.0 - BURST_S - 2 * seconds
    assert line.most == 1
    assert share.used_s == pytest.approx(used)


@pytest.mark.long
async def test_line_time_used_in_any_second_is_at_most_share_plus_burst() -> None:
    share, line = LineShare(), PacedLine(0.01)
    await flood(share, line, 30.0)
    first = line.begun[0]
    for second in range(28):
        window = [at for at in line.begun if second <= at - first < second + 1]
        assert len(window) * 0.01 <= SHARE + BURST_S + 0.01 + 1e-6


async def test_ninth_waiting_request_is_refused_immediately() -> None:
    share, line = LineShare(), PacedLine(0.5)
    asked = [share.ask("one", line.ask) for _ in range(1 + MOST_WAITING)]  # the first is in progress
    await asyncio.sleep(0)
    with pytest.raises(PassingBusy, match="8 requests wait"):
        share.ask("one", line.ask)
    results = await asyncio.gather(*asked, return_exceptions=True)
    assert results[0] == [1]
    assert all(isinstance(result, PassingBusy) for result in results[1:])  # the share is used up


async def test_request_that_waited_a_second_is_dropped() -> None:
    loop = asyncio.get_running_loop()
    share, line = LineShare(), PacedLine(1.5)
    first, second = share.ask("one", line.ask), share.ask("two", line.ask)
    begun = loop.time()
    with pytest.raises(PassingBusy, match="within 1 s"):
        await second
    assert loop.time() - begun == pytest.approx(EXPIRY_S)
    assert await first == [1]
    await asyncio.sleep(60)
    assert len(line.begun) == 1


async def test_work_gets_the_seconds_until_its_expiry() -> None:
    share, line = LineShare(), PacedLine(0.15)
    first, second = share.ask("one", line.ask), share.ask("one", line.ask)
    await asyncio.gather(first, second)
    assert line.left == [pytest.approx(1.0), pytest.approx(0.85)]


async def test_last_request_of_a_greedy_client_is_dropped_for_another_client() -> None:
    share, line = LineShare(), PacedLine(0.01)
    greedy = [share.ask("greedy", line.ask) for _ in range(1 + MOST_WAITING)]
    await asyncio.sleep(0)
    modest = share.ask("modest", line.ask)
    results = await asyncio.gather(*greedy, return_exceptions=True)
    assert [isinstance(result, PassingBusy) for result in results] == [False] * MOST_WAITING + [True]
    assert await modest


async def test_requests_of_a_disconnected_client_are_dropped_but_the_current_one_ends() -> None:
    share, line = LineShare(), PacedLine(0.1)
    gone = [share.ask("gone", line.ask) for _ in range(3)]
    stays = share.ask("stays", line.ask)
    await asyncio.sleep(0.05)
    for asked in gone:
        asked.cancel()
    assert await stays == [2]
    assert line.most == 1
    assert line.begun[1] - line.begun[0] >= 0.1


async def test_failed_request_raises_for_its_client_and_the_next_one_runs() -> None:
    async def fails(left: float) -> list[int]:
        raise TimeoutError("no reply")

    share, line = LineShare(), PacedLine(0.01)
    first, second = share.ask("one", fails), share.ask("one", line.ask)
    with pytest.raises(TimeoutError):
        await first
    assert await second == [1]


async def test_closing_refuses_waiting_requests() -> None:
    share, line = LineShare(), PacedLine(0.1)
    share.ask("one", line.ask)
    waits = share.ask("one", line.ask)
    await asyncio.sleep(0.01)
    share.close()
    with pytest.raises(PassingBusy, match="the gateway is shutting down"):
        await waits
