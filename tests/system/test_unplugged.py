"""Adapters that are unplugged, reset or plugged in elsewhere, and damaged replies, with the Linux drivers."""

from __future__ import annotations

import re
from typing import Any

import pytest
from rig import Guest

pytestmark = pytest.mark.slow

KINDS = ["ftdi", "cp210x", "ch341", "pl2303", "acm"]
START, STOP = "01050000ff00", "01050001ff00"  # start of the frames that set these coils of drive 1
USB = pytest.mark.parametrize("kind", KINDS)


def check_recovered(found: dict[str, Any]) -> None:
    """Check that each line lost its port and was polled again later, without a wrong value."""
    assert found["status"] == 0
    assert found["wrong"] == []
    for line, statuses in found["statuses"].items():
        loss = statuses.index("port lost")
        assert "ok" in statuses[:loss], line
        assert "ok" in statuses[loss:], line


# ---- unplugged and plugged in again ----


@pytest.mark.parametrize("kinds", [["ftdi", "acm"], pytest.param(KINDS, marks=pytest.mark.long)])
def test_polling_continues_when_unplugged_adapters_are_back(guest: Guest, kinds: list[str]) -> None:
    found = guest.run("poll_through_unplug", kinds=kinds, names="path")
    check_recovered(found)
    assert found["statuses"].keys() == set(kinds)
    assert "lost (unplugged)" in found["output"]
    assert found["same names"]


@pytest.mark.long
def test_only_the_stop_is_sent_after_an_adapter_is_plugged_in_again(guest: Guest) -> None:
    found = guest.run("commands_while_unplugged", kind="ftdi")
    assert found["ended"]["start"].startswith("PortLost")
    assert found["ended"]["set_frequency"].startswith("PortLost")
    assert found["was pending"]
    assert "CommandOutcome.DONE" in found["ended"]["stop"]
    assert found["state"] == "stopped"
    assert any(frame.startswith(STOP) for frame in found["writes"])
    assert not any(frame.startswith(START) for frame in found["writes"])


@pytest.mark.long
@pytest.mark.parametrize("names", ["path", "by_id", "by_path"])
def test_drives_are_not_confused_when_adapters_exchange_tty_names(guest: Guest, names: str) -> None:
    found = guest.run("changed_names", how=names)
    assert found["names after"] == found["names"][::-1]
    assert found["wrong"] == []
    if names != "by_path":  # a name in by_path means the USB socket, which has the other adapter now
        assert found["requests to the other"] == [0, 0]
    assert found["came back"] == (names != "path")  # a port named by its device path stays lost


# ---- damaged replies ----


@pytest.mark.parametrize(
    ("format", "kinds"), [("8E1", ["parity", "framing", "break"]), ("8N1", ["framing", "break"])]
)
def test_reply_marked_by_the_driver_as_damaged_raises_bad_reply(
    guest: Guest, format: str, kinds: list[str]
) -> None:
    found = guest.run("damaged_replies", format=format, kinds=kinds)
    for kind in kinds:
        assert found[kind].startswith("BadReply"), kind
        assert found[f"after {kind}"] == "528.0", kind
    assert found["counts"].keys() <= {"bad checksum", "no reply", "not asked: late reply due"}
    assert found["counts"]["bad checksum"] >= len(kinds)


def test_a_poll_counts_every_damaged_reply(guest: Guest) -> None:
    """Ten requests read two registers each. After a late reply, some damaged replies belong to no row."""
    found = guest.run("damaged_poll", kind="framing", count=10)
    assert found["wrong"] == []
    damaged = found["counts"]["bad checksum"]
    assert 0 < damaged <= 20
    late = found["counts"].get("no reply", 0) + found["counts"].get("not asked: late reply due", 0)
    assert damaged + late >= 20
    assert sum(map(int, re.findall(r"bad checksum (\d+)", found["output"]))) == damaged


# ---- other USB sockets, resets, gateway and monitor ----


@pytest.mark.long
def test_an_adapter_moved_to_another_usb_socket_is_polled_again(guest: Guest) -> None:
    found = guest.run("other_socket", is_anonymous=False, names="by_id")
    check_recovered(found)
    assert found["elsewhere"]


@pytest.mark.long
def test_adapter_without_serial_number_is_identified_by_the_usb_socket(guest: Guest) -> None:
    found = guest.run("other_socket", is_anonymous=True, names="by_path")
    check_recovered(found)
    assert not found["elsewhere"]
    named = guest.run("doctor_without_serial_number")
    assert "by-id" not in named["adapter"]["advice"]
    assert named["by_path"].startswith("/dev/serial/by-path/")


@pytest.mark.long
@pytest.mark.parametrize("names", ["path", "by_id"])
@USB
def test_a_reset_adapter_is_polled_again(guest: Guest, kind: str, names: str) -> None:
    """If the port works again before the next request, no row has the status "port lost"."""
    found = guest.run("reset_in_poll", kind=kind, names=names)
    assert found["status"] == 0
    assert found["wrong"] == []
    assert found["statuses"]["a"][-1] == "ok"


@pytest.mark.long
def test_start_is_sent_at_most_once_if_the_adapter_is_reset(guest: Guest) -> None:
    delays = [0.0, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 1.0]  # a busy computer needs long for a start
    facts = guest.run("reset_in_start", kind="ftdi", delays=delays)
    for fact in facts:
        starts = [frame for frame in fact["writes"] if frame.startswith(START)]
        assert len(starts) <= 1, fact
        assert "CommandOutcome.DONE" in fact["stop"], fact
    assert any(frame.startswith(START) for fact in facts for frame in fact["writes"])


@pytest.mark.long
def test_a_gateway_reports_an_unplugged_adapter_and_recovers(guest: Guest) -> None:
    found = guest.run("gateway")
    assert [found[moment]["status"] for moment in ("before", "unplugged", "after")] == [
        "ok",
        "degraded",
        "ok",
    ]
    assert re.search("lost|no such port", found["unplugged"]["lines"]["a"])
    assert found["end"][0] == 0


@pytest.mark.long
def test_a_monitor_shows_an_unplugged_adapter_and_recovers(guest: Guest) -> None:
    found = guest.run("monitor")
    for moment in ("before", "unplugged", "after"):
        assert found[f"{moment} shown"] is None, found[moment][-2000:]
    assert found["status"] == 0
