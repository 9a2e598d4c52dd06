"""Rights: what each user of a fleet may publish and subscribe to in its NATS servers. Pure.

| user      | may                                                                                         |
|-----------|---------------------------------------------------------------------------------------------|
| a gateway | say its own samples, write leases in its own name, write owners of lines, read all records, |
|           | take commands of any line and requests about itself, answer them, bring leaders home        |
| hub       | read the stream of samples                                                                  |
| viewer    | read all records, ask gateways about themselves                                             |
| commander | what a viewer may, and ask for commands                                                     |
| operator  | what a viewer may, and make what is missing, store the plant, drain gateways                |

Nobody may change, empty or remove a stream (but for the one that `fleet init` tries servers with), make a
consumer, or read another user's answers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from multidrop.fleet.samples.samples_stream import STREAM
from multidrop.fleet.servers import names
from multidrop.fleet.servers.setup import CONTEST

API = "$JS.API"


class UserRights(NamedTuple):
    """Subjects that a user may publish and subscribe to, besides its inbox."""

    publish: Sequence[str]
    subscribe: Sequence[str] = ()
    answers: bool = False  # to requests that reach it, where the asker wants the answer


def _api(request: str, *buckets: str) -> list[str]:
    return [f"{API}.{request}.KV_{bucket}" for bucket in buckets]


READ = [*_api("STREAM.INFO", *names.BUCKETS), *_api("DIRECT.GET", *names.BUCKETS)]
LEADERS = _api("STREAM.LEADER.STEPDOWN", *names.LEASES, *names.OWNERS)
LOOK = [*READ, names.gateway_subject("*", "state")]


def _gateway(name: str) -> UserRights:
    return UserRights(
        [
            *READ,
            *LEADERS,
            *_api("STREAM.MSG.GET", *names.LEASES),
            *(f"$KV.{bucket}.*.{name}" for bucket in names.LEASES),
            *(f"$KV.{bucket}.*" for bucket in names.OWNERS),
            f"{STREAM}.{name}.*",
            f"{API}.STREAM.MSG.GET.{STREAM}",
        ],
        [
            names.gateway_subject(name, "*"),
            names.command_subject("*"),
            names.stop_subject("*"),
            names.do_subject(name, "*"),
        ],
        answers=True,
    )


def _operator(_: str) -> UserRights:
    made = [*(f"KV_{bucket}" for bucket in names.BUCKETS), STREAM]
    trial = f"KV_{CONTEST}"
    return UserRights(
        [
            *LOOK,
            *LEADERS,
            *(f"{API}.STREAM.CREATE.{stream}" for stream in made),
            f"{API}.STREAM.INFO.{STREAM}",
            f"$KV.{names.PLANT}.*",
            *(f"{API}.STREAM.{request}.{trial}" for request in ("CREATE", "INFO", "MSG.GET", "DELETE")),
            f"$KV.{CONTEST}.*.*",
            names.gateway_subject("*", "drain"),
        ]
    )


def _hub(_: str) -> UserRights:
    return UserRights([f"{API}.STREAM.INFO.{STREAM}", f"{API}.DIRECT.GET.{STREAM}"])


def _viewer(_: str) -> UserRights:
    return UserRights(LOOK)


def _commander(_: str) -> UserRights:
    return UserRights(
        [*LOOK, names.command_subject("*"), names.stop_subject("*"), names.do_subject("*", "*")]
    )


OTHERS: Mapping[str, Callable[[str], UserRights]] = {
    "hub": _hub,
    "operator": _operator,
    "viewer": _viewer,
    "commander": _commander,
}


def rights_of(gateways: Sequence[str]) -> dict[str, UserRights]:
    """Return the rights of each user of a fleet with these gateways, by name.

    Raises ValueError for a name that no subject can have, or that is another user's.
    """
    for name in gateways:
        names.checked_name("gateway", name)
        if name in OTHERS or gateways.count(name) > 1:
            raise ValueError(
                f"{name!r} is there twice: each gateway has a name of its own, and not {', '.join(OTHERS)}"
            )
    found = {name: _gateway(name) for name in gateways}
    return found | {name: make(name) for name, make in OTHERS.items()}
