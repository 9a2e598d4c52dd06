"""Whole fleets with the rights of `fleet rights`: gateways join and die, keys are revoked and stolen."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from secured_clusters import (
    GATEWAYS,
    PATIENCE_S,
    SecuredCluster,
    SecuredFleet,
    multidrop,
    secured_fleet,
    until,
)

from multidrop.fleet.errors import Conflict
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import LeaseBucket
from multidrop.fleet.servers.connections import paths_of

pytestmark = [pytest.mark.slow, pytest.mark.long]

NOT_SENT = "the stop of drive-line-0 was NOT sent: these credentials do not allow publishing to stop.line-0"
AN_HOUR_AHEAD = """
import time
seconds, ns = time.time, time.time_ns
time.time, time.time_ns = lambda: seconds() + 3600, lambda: ns() + 3600 * 10**9
"""


def check_that_a_stop_reports_its_progress(fleet: SecuredFleet) -> None:
    """Check that the sender of a stop first gets the drive's refusal, and later the stop's outcome."""
    fleet.hall.refusing.add("line-1")
    asker = subprocess.Popen(
        [sys.executable, "-m", "multidrop", "fleet", "stop", "drive-line-1"],
        env=fleet.servers.environment("commander"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert asker.stderr
    told = asker.stderr.readline()
    while "the stop was sent" not in told:  # a busy machine may need more than half a second to send the stop
        assert told.startswith("under way: "), told
        told = asker.stderr.readline()
    assert told.startswith("under way: drive-line-1: the stop was sent, but is not yet confirmed")
    assert asker.poll() is None
    fleet.hall.refusing.clear()
    out, err = asker.communicate(timeout=PATIENCE_S)
    assert out.startswith("done: drive-line-1: stopped: seen to stand after "), (out, err)


def test_a_whole_fleet_works_with_the_generated_rights(tmp_path: Path) -> None:
    """The steps: cold start, a new gateway, a dead gateway, a drain and the hub. No log reports a denial.

    The servers read the new gateway's rights while the other gateways continue. NATS 2.15 gives a new account
    its imports only at the second reload.
    """
    with secured_fleet(tmp_path, 3, GATEWAYS[:2]) as fleet:
        fleet.wait_for_polling()
        fleet.servers.give_rights_to(GATEWAYS)
        fleet.servers.reload()
        fleet.start("gw-c")
        until(lambda: bool(fleet.status()["gateways"].get("gw-c", {}).get("lines")), "gw-c has lines")
        fleet.wait_for_polling()
        taken = fleet.status("commander")["gateways"]
        assert {name: one["session"] for name, one in taken.items()} == dict.fromkeys(GATEWAYS, 1)
        assert all(one["lines"] for one in taken.values())
        stopped = multidrop(fleet.servers, "commander", "fleet", "stop", "--all")
        assert stopped.returncode == 0, stopped
        assert "drive-line-" in (tmp_path / "gw-c" / "commands.jsonl").read_text()
        for user, told in (("commander", "drive-line-0"), ("viewer", NOT_SENT)):
            said = multidrop(fleet.servers, user, "fleet", "stop", "drive-line-0")
            assert told in said.stdout + said.stderr
            assert ("do not allow" in said.stdout + said.stderr) is (user == "viewer"), said
        check_that_a_stop_reports_its_progress(fleet)
        assert "drive-line-0" in "".join(path.read_text() for path in tmp_path.glob("gw-*/commands.jsonl"))
        fleet.kill("gw-a")
        until(lambda: "gw-a" not in fleet.status()["gateways"], "gw-a has left")
        fleet.wait_for_polling()
        drained = multidrop(fleet.servers, "operator", "fleet", "drain", "gw-b")
        assert (drained.returncode, drained.stderr) == (0, "")
        fleet.wait_for_polling()
        fleet.running["gw-c"].terminate()
        fleet.running["gw-c"].wait(PATIENCE_S)
        words = ["--parquet", str(tmp_path / "hub"), "--once", "--json"]
        kept = json.loads(multidrop(fleet.servers, "hub", "hub", *fleet.servers.urls, *words).stdout)
        assert kept["rows"] > 100
        assert kept["alarms"] == 0
        assert fleet.hall.overlaps() == 0
        for name in GATEWAYS:
            assert "do not allow" not in fleet.log(name)
            assert "Traceback" not in fleet.log(name)


def test_a_gateway_with_a_revoked_key_logs_it_and_others_take_its_lines(tmp_path: Path) -> None:
    """When the servers reload their rights, they disconnect users that were removed."""
    with secured_fleet(tmp_path, 1, ("gw-a", "gw-b")) as fleet:
        fleet.wait_for_polling()
        fleet.servers.give_rights_to(["gw-b"])
        until(lambda: "refuses these credentials" in fleet.log("gw-a"), "gw-a logs it")
        until(lambda: "all lines are closed" in fleet.log("gw-a"), "gw-a closes its lines")
        fleet.wait_for_polling()
        assert fleet.running["gw-a"].poll() is None  # the gateway continues to run, and retries
        # the refusal is logged once per connection, not at each attempt
        assert fleet.log("gw-a").count("admits nobody") < 10


async def end_session(servers: SecuredCluster, name: str) -> None:
    """End a gateway's session with the key of gw-c."""
    path = paths_of(servers.urls, servers.options("gw-c"))[0]
    await path.open()
    for at in names.LEASES:
        bucket, is_ended = LeaseBucket(at, lambda: path, "gw-c"), False
        while not is_ended:
            record = await bucket.get(name)
            with suppress(Conflict):
                await bucket.put(name, {**record.value, "ended": True}, record.revision)
                is_ended = True
    await path.close()


def test_a_thief_with_a_gateways_key_can_only_interrupt_polling(tmp_path: Path) -> None:
    """A thief with the key of gw-c ends the sessions of other gateways, which then start new sessions."""
    with secured_fleet(tmp_path, 1, GATEWAYS[:2]) as fleet:
        fleet.servers.give_rights_to(GATEWAYS)
        fleet.servers.reload()
        fleet.wait_for_polling()
        until(lambda: len(fleet.status()["gateways"]) == 2, "both gateways have joined")

        def session(name: str) -> int:
            return int(fleet.status()["gateways"].get(name, {"session": 0})["session"])

        def has_new_session(name: str, before: int) -> bool:
            return session(name) > before

        for name in GATEWAYS[:2]:
            before = session(name)
            asyncio.run(asyncio.wait_for(end_session(fleet.servers, name), PATIENCE_S))
            until(partial(has_new_session, name, before), "a new session")
            assert "another gateway ended" in fleet.log(name)
        fleet.wait_for_polling()
        assert fleet.hall.overlaps() == 0


def test_clocks_an_hour_apart_are_logged_and_harmless(tmp_path: Path) -> None:
    """The clock of one of two gateways is an hour ahead. Each gateway takes over the lines of the other."""
    (tmp_path / "ahead").mkdir()
    (tmp_path / "ahead" / "sitecustomize.py").write_text(AN_HOUR_AHEAD)
    ahead = {"gw-a": {"PYTHONPATH": str(tmp_path / "ahead")}, "gw-b": {}}
    with secured_fleet(tmp_path, 1, ("gw-a", "gw-b"), ahead) as fleet:
        until(
            lambda: "this machine's clock is 3600 s ahead of that of tls://" in fleet.log("gw-a"),
            "gw-a logs it",
        )

        def are_two() -> bool:
            return [bool(one["lines"]) for one in fleet.status()["gateways"].values()] == [True, True]

        until(are_two, "both gateways have lines")
        for name in ("gw-b", "gw-a"):
            fleet.kill(name)
            until(lambda name=name: name not in fleet.status()["gateways"], "it has left")
            fleet.wait_for_polling()
            if name == "gw-b":
                fleet.start(name)
                until(are_two, "both gateways have lines")
        assert "this machine's clock" not in fleet.log("gw-b")
        assert fleet.hall.overlaps() == 0


def test_a_second_gateway_of_the_same_name_waits_until_the_first_one_ends(tmp_path: Path) -> None:
    """The second gateway has another folder, as on another machine."""
    with secured_fleet(tmp_path, 1, ("gw-a",)) as fleet:
        fleet.wait_for_polling()
        fleet.start("gw-a", "second")
        sentence = "gw-a polls no lines yet: a gateway called gw-a runs on"
        until(lambda: sentence in fleet.log("second"), "it logs that it waits")
        assert fleet.status()["gateways"]["gw-a"]["session"] == 1
        fleet.kill("gw-a")
        until(
            lambda: fleet.status()["gateways"].get("gw-a", {}).get("session") == 2,
            "the second gateway takes over",
        )
        fleet.wait_for_polling()
        assert fleet.log("second").count(sentence) == 1
        assert fleet.hall.overlaps() == 0
