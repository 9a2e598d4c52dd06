"""Accounts: one for all that is stored, without any user, and one for each user. Pure.

NATS sends an answer to whatever subject its asker names, and asks nobody whether he may write there. So each
user has an account of its own, which the answers to it do not leave. Between accounts there is only:

| from             | to               | what                                                                 |
|------------------|------------------|----------------------------------------------------------------------|
| a user           | the store        | requests of JetStream and records that it may write, as services     |
| whoever commands | each gateway     | commands, stops and requests about the gateway, as streams           |
| a gateway        | whoever commands | answers to his inbox, as a service                                   |

A server sends nothing on to a stream's importers that came through a service, so no answer becomes a stop.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping

from multidrop.fleet.samples.samples_stream import STREAM
from multidrop.fleet.servers.credentials import inbox_of
from multidrop.fleet.servers.rights import UserRights

STORE = "multidrop"
LAST_ANSWER = "10s"  # of several: none comes later, and the server remembers the asker for so long
ANSWER = '{ max: 1, expires: "1m" }'  # of a request: a stop of many drives takes its time
_STORED = ("$JS.", "$KV.", f"{STREAM}.")
_MANY = "$JS.API.DIRECT.GET."  # these have several answers each
# In an account without JetStream a server answers to all of its API that it is not enabled, unless this
# is imported. Nobody may ask it.
_INFO = "$JS.API.INFO"


def accounts(rights: Mapping[str, UserRights], public: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of a server's configuration for these users, with their public keys."""
    asked = {name: [one for one in mine.publish if one.startswith(_STORED)] for name, mine in rights.items()}
    yield "accounts {"
    yield f"  {STORE} {{ jetstream: enabled, exports: ["
    for subject in sorted({_INFO, *(one for subjects in asked.values() for one in subjects)}):
        many = f", response_type: stream, threshold: {LAST_ANSWER}" if subject.startswith(_MANY) else ""
        yield f"    {{ service: {json.dumps(subject)}{many} }}"
    yield "  ] }"
    for name, mine in rights.items():
        others = [other for other in rights if other != name] if mine.answers else []
        yield f"  {account_of(name)} {{"
        yield "    exports: ["
        if wanted := _wanted(mine):
            yield from (f"      {{ stream: {json.dumps(subject)} }}" for subject in wanted)
            yield f"      {{ service: {json.dumps(_answers(public[name]))} }}"
        yield "    ]"
        yield "    imports: ["
        yield from (_import("service", STORE, subject) for subject in (_INFO, *asked[name]))
        for other in others:
            if heard := list(_shared(_wanted(rights[other]), mine.subscribe)):
                yield from (_import("stream", account_of(other), subject) for subject in heard)
                yield _import("service", account_of(other), _answers(public[other]))
        yield "    ]"
        yield from _user(name, mine, public[name])
        yield "  }"
    yield "}"


def account_of(user: str) -> str:
    """Return the name of a user's account, which is never the store's."""
    return f"{STORE}-{user}"


def _wanted(mine: UserRights) -> list[str]:
    """Return what a user may ask gateways for."""
    return [subject for subject in mine.publish if not subject.startswith(_STORED)]


def _answers(public: str) -> str:
    return f"{inbox_of(public)}.>"


def _import(kind: str, account: str, subject: str) -> str:
    return f"      {{ {kind}: {{ account: {account}, subject: {json.dumps(subject)} }} }}"


def _shared(some: Iterable[str], others: Iterable[str]) -> Iterator[str]:
    """Yield the subjects that are among both, where * stands for any one word."""
    for one in some:
        for other in others:
            words = list(zip(one.split("."), other.split("."), strict=False))
            is_as_long = one.count(".") == other.count(".")
            if is_as_long and all(mine == its or "*" in (mine, its) for mine, its in words):
                yield ".".join(its if mine == "*" else mine for mine, its in words)


def _user(name: str, mine: UserRights, public: str) -> Iterator[str]:
    yield "    users: ["
    yield f"      {{ # {name}"
    yield f"        nkey: {public}, permissions: {{"
    yield f"          publish: {{ allow: {json.dumps(list(mine.publish))} }}"
    yield f"          subscribe: {{ allow: {json.dumps([_answers(public), *mine.subscribe])} }}"
    if mine.answers:
        yield f"          allow_responses: {ANSWER}"
    yield "        }"
    yield "      }"
    yield "    ]"
