"""Stop asking: a stop is brought to whoever is the line's master, or will be soon."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from multidrop.fleet.commands.words import CommandAnswer, CommandOutcome, StopRequest, encode, read_answer
from multidrop.fleet.errors import FleetError, MayNotSend, NobodyThere, NotDelivered
from multidrop.fleet.servers import names
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.task_end import end_tasks

NOBODY_S = 6.0  # for which a line without a master is asked again: it has one within 1 s, or 4 after a death
AGAIN_S = 0.2
HARD_WIRED = "use the hard-wired stop"

News = Callable[[CommandAnswer], object]


async def first_answer(
    paths: Sequence[ServerPath], line: str, request: StopRequest, what: str, on_news: News
) -> CommandAnswer:
    """Ask until a gateway answers, or may have been asked; or return that none was, which is certain.

    That no gateway is there yet is told at once.
    """
    loop = asyncio.get_running_loop()
    ends, told = loop.time() + NOBODY_S, ""
    while True:
        try:
            return await _ask_all(paths, line, request, what)
        except NotDelivered as failure:
            why = f"no gateway is master of line {line}" if isinstance(failure, NobodyThere) else str(failure)
            if loop.time() > ends or isinstance(failure, MayNotSend):
                sentence = f"{what} was NOT sent: {why}; {HARD_WIRED}"
                return CommandAnswer(CommandOutcome.NOT_SENT, sentence)
        if why != told:
            told = why
            sentence = f"{what} was NOT sent yet: {why}; {HARD_WIRED}"
            on_news(CommandAnswer(CommandOutcome.UNDER_WAY, sentence))
        await asyncio.sleep(AGAIN_S)


async def _ask_all(paths: Sequence[ServerPath], line: str, request: StopRequest, what: str) -> CommandAnswer:
    """Ask on all paths at once, and return the first answer; no path waits for one that hangs.

    Raises NotDelivered where each of them says that nobody was asked: that nobody is there, if one says so.
    """
    subject, data = names.stop_subject(line), encode(request)
    asking = [asyncio.create_task(path.request(subject, data)) for path in paths]
    failures: list[NotDelivered] = []
    try:
        for asked in asyncio.as_completed(asking):
            try:
                return read_answer((await asked).data)
            except NotDelivered as failure:
                failures.append(failure)
            except (FleetError, ValueError):
                pass
    finally:
        await end_tasks(*asking)
    if len(failures) == len(paths):
        raise min(failures, key=lambda failure: not isinstance(failure, NobodyThere))
    return CommandAnswer(CommandOutcome.UNDER_WAY, f"{what}: no gateway has answered yet; {HARD_WIRED}")
