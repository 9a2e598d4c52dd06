"""Answers in JetStream's place that are none: each is one sentence, and ends no gateway, forwarder or hub."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from peers import require_module

require_module("nats")

from multidrop.fleet import samples_stream  # noqa: E402
from multidrop.fleet.buckets import Bucket, Record, ask  # noqa: E402
from multidrop.fleet.errors import FleetError, Unsure  # noqa: E402
from multidrop.fleet.samples_stream import StreamError  # noqa: E402

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


class Liar:
    """A path, or a connection, whose every request has this answer."""

    url = "nats://liar"
    is_connected = True
    last_error = None

    def __init__(self, answer: bytes) -> None:
        self.answer = answer

    async def request(self, *_: Any, **__: Any) -> Any:
        return SimpleNamespace(data=self.answer)

    async def request_all(self, requests: Sequence[Any]) -> list[bytes]:
        return [self.answer for _ in requests]


def bucket_of(answer: bytes) -> Bucket:
    return Bucket("own_0", lambda: Liar(answer))  # type: ignore[arg-type,return-value]


@pytest.mark.parametrize("name", [*STRANGE, *PARTS])
def test_a_record_whose_storing_is_not_told_may_be_stored_or_not(name: str) -> None:
    bucket = bucket_of({**STRANGE, **PARTS}[name])
    with pytest.raises(Unsure, match="what NATS answers "):
        asyncio.run(bucket.put("a", {}, 1))
    assert asyncio.run(bucket.put_all([Record("a", 1, {})])) == []


@pytest.mark.parametrize("name", [*STRANGE, *PARTS])
def test_a_record_that_is_none_is_not_read(name: str) -> None:
    with pytest.raises(Unsure, match="what NATS answers "):
        asyncio.run(bucket_of({**STRANGE, **PARTS}[name]).get("a"))


@pytest.mark.parametrize("name", STRANGE)
def test_what_is_no_answer_about_a_stream_is_one_sentence(name: str) -> None:
    with pytest.raises(FleetError, match="what NATS answers is no answer of JetStream"):
        asyncio.run(ask(Liar(STRANGE[name]), "STREAM.INFO.KV_own_0"))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", [*STRANGE, *PARTS])
def test_a_stream_of_samples_that_answers_nonsense_is_tried_again(name: str) -> None:
    """Forwarder and hub try again after a StreamError, and end by any other."""
    client: Any = Liar({**STRANGE, **PARTS}[name])
    with pytest.raises(StreamError, match="NATS answers something else than "):
        asyncio.run(samples_stream.about(client))
    with pytest.raises(StreamError, match="NATS answers something else than "):
        asyncio.run(samples_stream.last_of(client, "samples.gw.log"))
    with pytest.raises(StreamError, match="NATS answers something else than "):
        asyncio.run(samples_stream.publish(client, "samples.gw.log", b"", {}))
