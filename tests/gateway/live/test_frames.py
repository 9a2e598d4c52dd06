"""Messages to the page: shared by all viewers, at most five a second, never queued."""

from __future__ import annotations

import asyncio
import gzip
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from controlled_loop import Clock
from gateways import written
from hypothesis import given
from hypothesis import strategies as st

from multidrop.gateway.gateway import Gateway
from multidrop.gateway.http.routes import FrameRoute
from multidrop.gateway.live import frames as module
from multidrop.gateway.live.frames import KEPT, WHOLE, Encoded, Frames, changes
from multidrop.gateway.settings import ServeSettings


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def made() -> list[int]:
    return []


@pytest.fixture
def frames(clock: Clock, made: list[int]) -> Frames:
    def make(n: int) -> dict[str, Any]:
        made.append(n)
        return {"n": n, "revision": 1}

    return Frames(make, clock)


async def test_a_hundred_viewers_get_the_same_message_object(
    frames: Frames, clock: Clock, made: list[int]
) -> None:
    first = await frames.after(-1)
    assert first is not None
    viewers = [asyncio.create_task(frames.after(first.n)) for _ in range(100)]
    await asyncio.sleep(0)
    assert frames.viewers == 100
    clock.now += 0.25
    frames.note_news()
    found = await asyncio.gather(*viewers)
    assert {id(one) for one in found} == {id(found[0])}
    assert found[0] is not None
    assert json.loads(gzip.decompress(found[0].gzipped)) == told(found[0]) == {"n": 2, "since": 1}
    assert frames.viewers == 0
    assert made == [1, 2]


async def test_changes_between_two_messages_are_computed_once_for_all_viewers(
    frames: Frames, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared: list[int] = []

    def compare(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
        compared.append(before["n"])
        return changes(before, now)

    monkeypatch.setattr(module, "changes", compare)
    first = await frames.after(WHOLE)
    assert first is not None
    viewers = [asyncio.create_task(frames.after(first.n)) for _ in range(5)]
    await asyncio.sleep(0)
    clock.now += 0.25
    frames.note_news()
    assert [told(frame) for frame in await asyncio.gather(*viewers)] == [{"n": 2, "since": 1}] * 5
    assert compared == [1]


async def test_at_most_five_messages_are_made_per_second(
    frames: Frames, clock: Clock, made: list[int]
) -> None:
    seen = -1
    for _ in range(1000):  # 10 s with a change every 10 ms
        clock.now += 0.01
        viewer = asyncio.create_task(frames.after(seen))
        await asyncio.sleep(0)
        frames.note_news()
        await asyncio.sleep(0)
        if viewer.done() and (frame := viewer.result()):
            seen = frame.n
        else:
            viewer.cancel()
            await asyncio.gather(viewer, return_exceptions=True)
    assert 45 <= len(made) <= 51


async def test_new_values_are_sent_as_soon_as_the_next_message_is_due(frames: Frames, clock: Clock) -> None:
    """The message is made even if no further rows arrive."""
    first = await frames.after(-1)
    assert first is not None
    frames.note_news()
    viewer = asyncio.create_task(frames.after(first.n))
    await asyncio.sleep(0)
    assert not viewer.done()
    clock.now += 0.25
    second = await viewer
    assert second is not None
    assert second.n == 2


def test_no_message_is_made_without_viewers(frames: Frames, clock: Clock, made: list[int]) -> None:
    for _ in range(100):
        clock.now += 1.0
        frames.note_news()
    assert made == []


async def test_a_viewer_gets_the_newest_message_after_an_absence(frames: Frames, clock: Clock) -> None:
    first = await frames.after(-1)
    assert first is not None
    for _ in range(50):  # newer messages, which the viewer does not request
        clock.now += 0.25
        frames.note_news()
        await frames.after(-1)
    late = await frames.after(first.n)
    assert late is not None
    assert late.n == 51
    assert told(late) == {"n": 51, "revision": 1}
    other = await frames.after(900)  # 900: the number of a frame that an earlier process made
    assert other is late


def told(frame: Encoded | None) -> dict[str, Any]:
    assert frame is not None
    found: dict[str, Any] = json.loads(frame.plain)
    return found


def merged(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return `before` updated with the values of `now`, including nested objects."""
    both = {key: merged(before[key], value) for key, value in now.items() if isinstance(value, dict)}
    return {**before, **now, **both}


values = st.none() | st.integers(0, 2) | st.lists(st.none() | st.integers(0, 2), max_size=2)
drives = st.fixed_dictionaries(
    {
        "state": st.sampled_from(["runs", "stands"]),
        "values": st.fixed_dictionaries({"a": values, "b": values}),
    }
)
plants = st.fixed_dictionaries(
    {"drives": st.fixed_dictionaries({"pump": drives, "fan": drives}), "c": values}
)


@given(plants, plants)
def test_a_message_plus_changes_gives_the_next_message(before: dict[str, Any], now: dict[str, Any]) -> None:
    said = changes(before, now)
    assert merged(before, said) == now
    assert changes(before, merged(before, said)) == said
    assert changes(now, now) == {}


async def view(pictures: list[tuple[dict[str, Any], int]], begin: int) -> None:
    """Check viewers that skip frames. Each picture is the data of a frame and a number of frames to skip."""
    clock, whole = Clock(), dict[int, dict[str, Any]]()

    def make(n: int) -> dict[str, Any]:
        at = n - begin - 1
        whole[n] = {"n": n, "revision": 2 * at // len(pictures), **pictures[at][0]}
        return whole[n]

    frames = Frames(make, clock, begin)
    has: dict[int, dict[str, Any]] = {}  # by viewer: its data; viewer 3 asks every third turn
    for turn, _ in enumerate(pictures):
        clock.now += 0.25
        frames.note_news()
        for every in {away + 1 for _, away in pictures}:
            if turn % every:
                continue
            mine = has.get(every)
            news = told(await frames.after(WHOLE if mine is None else mine["n"]))
            since = news.pop("since", None)
            if since is None:
                has[every] = news
            else:
                assert mine is not None
                assert since == mine["n"] > news["n"] - KEPT
                has[every] = merged(mine, news)
            assert has[every] == whole[max(whole)]


@pytest.mark.slow
@given(st.lists(st.tuples(plants, st.integers(0, 9)), min_size=2, max_size=12), st.integers(0, 2**32))
def test_viewers_get_correct_values_although_they_skip_messages(
    pictures: list[tuple[dict[str, Any], int]], begin: int
) -> None:
    """The frames' revision number changes in the middle of the run."""
    asyncio.run(view(pictures, begin))


async def test_a_waiting_viewer_gets_no_message_after_a_timeout_or_shutdown(
    frames: Frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "WAIT_S", 0.01)
    monkeypatch.setattr(module, "MOST_VIEWERS", 2)
    first = await frames.after(-1)
    assert first is not None
    assert await frames.after(first.n) is None
    monkeypatch.setattr(module, "WAIT_S", 1000.0)
    waiting = [asyncio.create_task(frames.after(first.n)) for _ in range(3)]
    await asyncio.sleep(0)
    assert [one.done() for one in waiting] == [False, False, True]
    with pytest.raises(OverflowError, match="too many viewers; the limit is 2"):
        await waiting.pop()
    frames.close()
    assert await asyncio.gather(*waiting) == [None, None]
    assert await frames.after(first.n) is None


async def test_too_many_viewers_get_an_error(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_VIEWERS", 0)
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    first = await frames.after(WHOLE)
    assert first is not None
    scope = {"type": "http", "query_string": f"after={first.n}".encode(), "headers": []}
    await FrameRoute(frames)(scope, None, send)  # type: ignore[arg-type]
    assert [one.get("status") for one in sent] == [503, None]
    assert json.loads(sent[1]["body"]) == {"error": "too many viewers; the limit is 0"}


def test_alarms_are_checked_before_a_message_to_the_page_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most every 0.2 s, the gateway checks drives for alarms and then makes a message to the page."""
    gateway = Gateway(written(tmp_path), ServeSettings(port=0))
    gateway.listener.close()
    done: list[str] = []
    monkeypatch.setattr(gateway, "_look_for_events", lambda: done.append("alarms"))
    monkeypatch.setattr(gateway.frames, "note_news", lambda: done.append("frame"))
    monkeypatch.setattr(gateway.hub, "take", lambda batch: None)
    for now, batches, expected in (
        (10.0, ["rows"], ["alarms", "frame"]),
        (10.1, ["rows"], []),
        (10.21, [], ["alarms", "frame"]),
        (10.31, [], []),
        (10.42, [], ["alarms"]),
    ):
        monkeypatch.setattr(gateway, "clock", lambda now=now: now)
        poller: Any = SimpleNamespace(take=lambda batches=batches: batches.pop() if batches else None)
        gateway.hand_out(poller)
        assert done == expected, now
        done.clear()
