"""Frames: made once for all viewers, ten a second at most, and none waits in a queue."""

from __future__ import annotations

import asyncio
import gzip
import json
from typing import Any

import pytest
from clocks import Clock

from multidrop.gateway import frames as module
from multidrop.gateway.frames import Frames


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
        return {"n": n}

    return Frames(make, clock)


def test_a_hundred_viewers_share_one_frame(frames: Frames, clock: Clock, made: list[int]) -> None:
    async def watch() -> None:
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
        assert json.loads(gzip.decompress(found[0].gzipped)) == json.loads(found[0].plain) == {"n": 2}
        assert frames.viewers == 0

    asyncio.run(watch())
    assert made == [1, 2]


def test_five_frames_a_second_at_most(frames: Frames, clock: Clock, made: list[int]) -> None:
    async def watch() -> None:
        seen = -1
        for _ in range(1000):  # 10 s of news every 10 ms
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

    asyncio.run(watch())
    assert 45 <= len(made) <= 51


def test_news_that_come_too_soon_are_not_forgotten(frames: Frames, clock: Clock) -> None:
    """Nothing else has to happen for them to be seen."""

    async def watch() -> None:
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

    asyncio.run(watch())


def test_nothing_is_made_for_nobody(frames: Frames, clock: Clock, made: list[int]) -> None:
    for _ in range(100):
        clock.now += 1.0
        frames.note_news()
    assert made == []


def test_a_viewer_who_comes_late_gets_the_newest_and_no_other(frames: Frames, clock: Clock) -> None:
    async def watch() -> None:
        first = await frames.after(-1)
        assert first is not None
        for _ in range(50):  # it does not ask meanwhile
            clock.now += 0.25
            frames.note_news()
            await frames.after(-1)
        late = await frames.after(first.n)
        assert late is not None
        assert late.n == 51
        other = await frames.after(900)  # seen of an earlier process
        assert other is late

    asyncio.run(watch())


def test_a_viewer_waits_and_is_let_go(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WAIT_S", 0.01)
    monkeypatch.setattr(module, "MOST_VIEWERS", 2)

    async def watch() -> None:
        first = await frames.after(-1)
        assert first is not None
        assert await frames.after(first.n) is None
        monkeypatch.setattr(module, "WAIT_S", 1000.0)
        waiting = [asyncio.create_task(frames.after(first.n)) for _ in range(2)]
        await asyncio.sleep(0)
        with pytest.raises(OverflowError, match="2 viewers wait already"):
            await frames.after(first.n)
        frames.close()
        assert await asyncio.gather(*waiting) == [None, None]
        assert await frames.after(first.n) is None

    asyncio.run(watch())
