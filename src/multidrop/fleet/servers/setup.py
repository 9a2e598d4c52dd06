"""Setup: tests a fleet's servers, then creates its buckets and streams."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from datetime import datetime
from functools import partial
from typing import Any, TypeVar

from multidrop.fleet.errors import Conflict, FleetError, NobodyThere, NoRight, OutcomeUnknown, TooOld
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import NONE_YET, Bucket, LeaseBucket, ServerError, ask, bucket_settings
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.leaders import bring_leaders_home, cluster_of, led_clusters

CONTEST = "contest"
ROUNDS = 40  # number of tests of concurrent writes; nats-server 2.9.10 fails one of the first few
CLAIMANTS = 6
MOST_REPLICAS = 3
WAIT_S = 10.0  # time limit of retries; an election takes 4 to 9 s
CLOCKS_APART_S = 10.0

T = TypeVar("T")

_log = logging.getLogger("multidrop.fleet")


async def set_up(paths: Sequence[ServerPath]) -> dict[str, Any]:
    """Create the missing buckets of a fleet, and return a summary. Raises FleetError with one sentence.

    Existing buckets stay as they are. Creating a bucket requires answers of all servers.
    """
    await open_all(paths)
    reached = min(MOST_REPLICAS, len({path.server_name for path in paths}))
    replicas = await _replicas(paths[0])
    away = [path.urls[0] for path in paths if path.url != path.urls[0]]
    if away and not replicas:
        raise FleetError(
            f"the NATS server {away[0]} does not answer, and would later hold no buckets. "
            "Start this server, or leave out its address"
        )
    replicas = replicas or reached
    await _contest(paths, reached)
    for bucket in names.BUCKETS:
        await _retried(paths[0], partial(_create, paths[0], bucket_settings(bucket, replicas)))
    # Wait until a server returns the bucket's records: right after its creation, no server does.
    await _retried(paths[0], partial(Bucket(names.PLANT, lambda: paths[0]).changes, 0))
    await bring_leaders_home(paths[0], await led_clusters(paths[0]))
    servers = {path.server_name: path.version for path in paths}
    return {"servers": servers, "replicas": replicas, "buckets": list(names.BUCKETS)}


async def open_all(paths: Sequence[ServerPath]) -> None:
    """Open all connections. Raises FleetError if no server answers, or if a server is too old."""
    results = await asyncio.gather(*(path.open() for path in paths), return_exceptions=True)
    failures = [result for result in results if isinstance(result, Exception)]
    too_old = [failure for failure in failures if isinstance(failure, TooOld)]
    if too_old or len(failures) == len(paths):
        raise (too_old or failures)[0]


async def check_buckets(path: ServerPath) -> None:
    """Raise FleetError if these servers have no fleet, or no quorum. Waits for an election in progress."""
    info = None
    for bucket in names.BUCKETS:
        info = await _retried(path, partial(_info, path, f"KV_{bucket}"))
        if info is None:
            raise FleetError(f"{path.url} has no bucket {bucket}: run `multidrop fleet init` first")
    check_clock(path, info and info.get("ts"))


def check_clock(path: ServerPath, server_time: Any) -> None:
    """Warn if this computer's clock differs from the server's: the times of samples would be wrong.

    Raises OutcomeUnknown if the server's time is invalid.
    """
    try:
        apart = time.time() - datetime.fromisoformat(server_time).timestamp()
    except (TypeError, ValueError, OverflowError):
        raise OutcomeUnknown(f"the answer of {path.url} about a bucket has no valid time stamp") from None
    if abs(apart) > CLOCKS_APART_S:
        _log.warning(
            "this machine's clock is %.0f s %s the clock of %s: set it, because samples get its time",
            abs(apart),
            "ahead of" if apart > 0 else "behind",
            path.url,
        )


def no_quorum(path: ServerPath, failure: Exception) -> FleetError:
    if isinstance(failure, NobodyThere):
        return FleetError(
            f"no JetStream answers at {path.url}: the configuration of each server needs "
            '`jetstream { store_dir: "/var/lib/nats" }`, and a running server must read new rights twice'
        )
    return FleetError(
        f"the NATS servers around {path.url} have no quorum: more than half of them must run and reach each "
        f"other ({failure})"
    )


async def _replicas(path: ServerPath) -> int:
    """Return the smallest number of servers that store a bucket; 0 if a bucket is missing."""
    infos = [await _retried(path, partial(_info, path, f"KV_{bucket}")) for bucket in names.BUCKETS]
    return min(1 + len(cluster_of(info, path).followers) if info else 0 for info in infos)


async def _info(path: ServerPath, stream: str) -> dict[str, Any] | None:
    """Return the state of a stream; None if it does not exist. Raises OutcomeUnknown without a leader."""
    try:
        info = await ask(path, f"STREAM.INFO.{stream}")
    except ServerError as failure:
        if failure.is_missing:
            return None
        raise
    if not cluster_of(info, path).leader:
        raise OutcomeUnknown(f"the bucket {stream.removeprefix('KV_')} has no leader")
    return info


async def _create(path: ServerPath, settings: Mapping[str, Any]) -> None:
    while await _info(path, settings["name"]) is None:
        await ask(path, f"STREAM.CREATE.{settings['name']}", settings)


async def _remove(path: ServerPath, stream: str) -> None:
    while await _info(path, stream) is not None:
        await ask(path, f"STREAM.DELETE.{stream}")


async def _retried(path: ServerPath, attempt: Callable[[], Awaitable[T]]) -> T:
    """Repeat an attempt for up to WAIT_S, because an election or another change may be in progress.

    Raises NoRight immediately. After WAIT_S, raises ServerError if the servers refuse the request, FleetError
    if they have no quorum.
    """
    loop = asyncio.get_running_loop()
    ends = loop.time() + WAIT_S
    while True:
        try:
            return await attempt()
        except NoRight:
            raise
        except FleetError as failure:
            if loop.time() > ends:
                raise failure if isinstance(failure, ServerError) else no_quorum(path, failure) from None
        await asyncio.sleep(0.1)


async def _contest(paths: Sequence[ServerPath], replicas: int) -> None:
    """Test many times that the servers accept only one of several concurrent writes to one revision.

    Raises FleetError if they accept two.
    """
    settings = bucket_settings(CONTEST, replicas)
    await _retried(paths[0], partial(_create, paths[0], settings))
    try:
        open_paths = [path for path in paths if path.is_open]
        claimants = [
            LeaseBucket(CONTEST, partial(open_paths.__getitem__, at % len(open_paths)), f"claimant-{at}")
            for at in range(CLAIMANTS)
        ]
        revision, rounds = NONE_YET, 0
        while revision == NONE_YET or rounds < ROUNDS:
            rounds += 1
            claims = [_claim(claimant, revision) for claimant in claimants]
            granted = [found for found in await asyncio.gather(*claims) if found is not None]
            if len(granted) > 1:
                raise FleetError(
                    f"{paths[0].url} and the other NATS servers accepted {len(granted)} of {CLAIMANTS} "
                    "concurrent writes to the same revision of a record. "
                    "Such servers could give one lease to two gateways"
                )
            if granted:
                revision = granted[0]
            else:
                revision = (await _retried(paths[0], partial(claimants[0].get, CONTEST))).revision
            if rounds > 2 * ROUNDS:
                raise no_quorum(paths[0], OutcomeUnknown("no attempt to claim a key succeeded"))
    finally:
        await _retried(paths[0], partial(_remove, paths[0], settings["name"]))


async def _claim(claimant: LeaseBucket, revision: int) -> int | None:
    try:
        return await claimant.put(CONTEST, {}, revision)
    except (Conflict, FleetError):
        return None
