"""Invalid answers instead of JetStream's: each is reported in one sentence, and ends no task."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from multidrop.fleet.errors import FleetError, Unsure
from multidrop.fleet.samples import samples_stream
from multidrop.fleet.servers import names, setup
from multidrop.fleet.servers.buckets import Bucket, Record
from multidrop.fleet.servers.leaders import Cluster, known_cluster, led_clusters
from multidrop.fleet.servers.setup import check_buckets

STRANGE = {
    "nothing": b"",
    "truncated": b'{"stream": "KV_own_0", "se',
    "no text": b"\xff\xfe\x00",
    "deep": b"[" * 500_000,
    "a number of 10,000 digits": b'{"seq": ' + b"9" * 10_000 + b"}",
    "a list": b"[1]",
    "null": b"null",
    "an error that is none": b'{"error": "no"}',
    "an error that is a list": b'{"error": [1]}',
}
PARTS = {
    "without a sequence": b"{}",
    "a text for a sequence": b'{"seq": "one"}',
    "a list for a sequence": b'{"seq": [1]}',
    "a message that is none": b'{"message": 5, "seq": null}',
    "a message of nothing": b'{"message": {}, "seq": null}',
    "no base 64": b'{"message": {"subject": "$KV.own_0.a", "seq": 1, "data": "QUI", "hdrs": "QUI"}}',
    "data of another kind": b'{"message": {"subject": "$KV.own_0.a", "seq": 1, "data": 5, "hdrs": 5}}',
    "a sequence that is none": b'{"message": {"subject": "$KV.own_0.a", "seq": "x"}, "config": 5}',
}
CLUSTERS = {
    "a text": b'{"cluster": "n1"}',
    "a list": b'{"cluster": [1]}',
    "null": b'{"cluster": null}',
    "replicas that are a table": b'{"cluster": {"leader": "n1", "replicas": {"name": "n2"}}}',
    "replicas that are texts": b'{"cluster": {"leader": "n1", "replicas": ["n2", "n3"]}}',
    "a replica without a name": b'{"cluster": {"leader": "n1", "replicas": [{"current": true}]}}',
    "a list for a time": b'{"cluster": {"leader": "n1", "replicas": [{"name": "n2", "active": [1]}]}}',
}
TIMES = {
    "none": b"{}",
    "a number": b'{"ts": 5}',
    "a text that is none": b'{"ts": "now"}',
    "the year one": b'{"ts": "0001-01-01T00:00:00"}',
}


class Liar:
    """A path or connection that gives this answer to every request."""

    url = "nats://liar"
    server_name = "liar"

    def __init__(self, answer: bytes) -> None:
        self.answer = answer
        self.asked: list[str] = []

    async def request(self, subject: str, *_: Any, **__: Any) -> Any:
        self.asked.append(subject)
        return SimpleNamespace(data=self.answer)

    async def request_all(self, requests: Sequence[Any]) -> list[bytes]:
        return [self.answer for _ in requests]


@pytest.mark.parametrize("name", [*STRANGE, *PARTS])
async def test_invalid_answers_leave_the_outcome_unknown_and_are_reported(name: str) -> None:
    """After a FleetError, gateway, forwarder and hub retry; any other exception would end them."""
    path: Any = Liar({**STRANGE, **PARTS}[name])
    bucket = Bucket("own_0", lambda: path)
    for request in (bucket.put("a", {}, 1), bucket.get("a")):
        with pytest.raises(Unsure, match="the answer of NATS "):
            await request
    assert await bucket.put_all([Record("a", 1, {})]) == ([], set())
    for request in (
        samples_stream.about(path),
        samples_stream.last_of(path, "samples.gw.log"),
        samples_stream.publish(path, "samples.gw.log", b"", {}),
    ):
        with pytest.raises(FleetError, match="the answer of NATS "):
            await request


@pytest.mark.parametrize("name", CLUSTERS)
async def test_invalid_cluster_states_are_reported_and_move_no_leader(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gateway's tasks that read cluster states must not end."""
    monkeypatch.setattr(setup, "WAIT_S", 0.0)  # do not wait for an election
    path: Any = Liar(CLUSTERS[name])
    with pytest.raises(FleetError, match="the answer of NATS about a bucket's servers is invalid"):
        await check_buckets(path)
    assert await known_cluster(path, names.OWNERS[0]) == Cluster()
    assert await led_clusters(path) == {}
    assert {subject.split(".KV_")[0] for subject in path.asked} == {"$JS.API.STREAM.INFO"}


@pytest.mark.parametrize("name", TIMES)
async def test_an_invalid_server_time_is_reported(name: str) -> None:
    path: Any = Liar(TIMES[name])
    with pytest.raises(Unsure, match="the answer of nats://liar about a bucket has no time"):
        await check_buckets(path)
