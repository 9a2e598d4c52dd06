"""One gateway of a fleet: which requests it answers, and how it shuts down."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from nats_clusters import cluster
from serial_hall import SerialHall

from multidrop.fleet import gateway as fleet_gateway
from multidrop.fleet.gateway import FleetGateway
from multidrop.fleet.servers import names

PATIENCE_S = 60.0


class Asked:
    """A request from NATS, and the answers to it."""

    def __init__(self, wanted: str, reply: str = "_INBOX.asker.1") -> None:
        self.subject = names.gateway_subject("gw-1", wanted)
        self.reply = reply
        self.answers: list[dict[str, Any]] = []

    async def respond(self, data: bytes) -> None:
        self.answers.append(json.loads(data))


async def test_a_gateway_that_waits_for_its_namesake_answers_no_requests(tmp_path: Path) -> None:
    """Its namesake gets the request too: `fleet status` would show, and `drain` trust, a wrong answer."""
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    lease = gateway.member.lease
    for wanted in ("state", "drain"):
        asked: Any = Asked(wanted)
        await gateway._answer(asked)
        assert (asked.answers, gateway.member.is_draining) == ([], False)
    lease.session = 7
    asked = Asked("state")
    await gateway._answer(asked)
    assert [answer["session"] for answer in asked.answers] == [7]
    await gateway._close()


async def test_a_request_with_a_foreign_reply_subject_is_ignored(tmp_path: Path) -> None:
    """Servers would deliver the answer there, even into a record that the requester may not write."""
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    gateway.member.lease.session = 7
    for reply in ("", "$KV.plant.line-1", "stop.line-1", "samples.gw-2.log", "_INBOX", "_INBOXES.a"):
        for wanted in ("state", "drain"):
            asked: Any = Asked(wanted, reply)
            await gateway._answer(asked)
            assert (asked.answers, gateway.member.is_draining) == ([], False)
    asked = Asked("drain", "_INBOX_UABC.1")
    await gateway._answer(asked)
    assert gateway.member.is_draining
    assert asked.answers
    await gateway._close()


@pytest.mark.parametrize(("trouble", "is_forwarded"), [(None, True), ("the stream is full", False)])
async def test_shutdown_waits_for_unsent_messages_unless_the_stream_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trouble: str | None, is_forwarded: bool
) -> None:
    monkeypatch.setattr(fleet_gateway, "FORWARD_S", PATIENCE_S)
    monkeypatch.setattr(fleet_gateway, "IN_TROUBLE_S", 0.0)
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    taken = iter([0, 0, 1])  # number of the spool's two messages that the stream has, at each check
    forwarder: Any = type(
        "Forwarding", (), {"trouble": trouble, "last": property(lambda _: next(taken, 2))}
    )()
    spool, gateway.forwarder = gateway.spool, forwarder
    monkeypatch.setattr(gateway, "spool", SimpleNamespace(state=lambda: SimpleNamespace(newest=2)))
    forwarding = asyncio.create_task(asyncio.sleep(PATIENCE_S))
    await gateway._forward_the_rest(forwarding)
    assert (next(taken, None) is None) == is_forwarded
    forwarding.cancel()
    gateway.spool = spool
    await gateway._close()


async def test_without_a_lease_the_margin_is_zero(tmp_path: Path) -> None:
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    assert gateway.state()["margin_s"] == 0.0
    await gateway._close()


async def test_the_kernels_timer_is_cancelled_after_the_lines_are_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the kernel would kill a process that continues after its member has failed."""
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    gateway.mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 3600 * 10**9)
    held: list[bool] = []
    close = gateway.lines.poller.close

    def noted() -> None:
        held.append(gateway.mastership.holds)
        close()

    monkeypatch.setattr(gateway.lines.poller, "close", noted)
    try:
        await gateway._close()
        assert (held, gateway.mastership.until_ns) == ([True], 0)
    finally:
        gateway.mastership.end()


@pytest.mark.long
@pytest.mark.slow
def test_without_servers_a_gateway_shuts_down_in_order(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "multidrop", "fleet"]
    with cluster(tmp_path / "nats", 1) as one, closing(SerialHall(1)) as hall:
        environment = {**os.environ, "MULTIDROP_NATS": one.urls[0], "XDG_STATE_HOME": str(tmp_path)}
        (tmp_path / "plant.toml").write_text(hall.plant())
        subprocess.run(
            [*words, "init", tmp_path / "plant.toml"], env=environment, check=True, timeout=PATIENCE_S
        )
        log = tmp_path / "gw-1.log"
        with log.open("w") as file:
            gateway = subprocess.Popen([*words, "serve", "gw-1"], env=environment, stderr=file)
        try:
            ends = time.monotonic() + PATIENCE_S
            while not hall.are_polled(0.5):
                assert time.monotonic() < ends, log.read_text()
                time.sleep(0.05)
            one.nodes[0].kill()
            while "all lines are closed" not in log.read_text():
                assert time.monotonic() < ends, log.read_text()
                time.sleep(0.05)
            gateway.terminate()
            assert gateway.wait(PATIENCE_S) == 0, log.read_text()
        finally:
            gateway.kill()
            gateway.wait()
