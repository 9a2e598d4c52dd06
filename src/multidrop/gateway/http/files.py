"""Files that the web server sends: the page, exports of the history, and drives' parameters."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
import zlib
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Generator, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from multidrop import params
from multidrop.gateway.http.messages import Denied
from multidrop.gateway.live.drive_reads import ParameterRead
from multidrop.printable import iso_time
from multidrop.supervisor import supervisor

PAGE = Path(__file__).parents[1] / "page"
INDEX = "index.html"
TEXTS = "texts.toml"
READ_S = 5.0  # time limit for reading all files
TYPES = {  # media types by suffix; files with other suffixes are plain text
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".json": "application/json",
}
# limit of concurrent exports: each uses a thread, and a Parquet file needs space on the history's disk
MOST_EXPORTS = 8
PIECE_S = 600.0  # time limit, in s, for making one piece of a file; a whole Parquet file is one piece
R = TypeVar("R")
MOST_NAME = 80  # limit of the characters of a series' name in a file name; longer names are cut
FORBIDDEN = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|]')  # characters that some systems forbid in file names
KINDS = {"csv": "text/csv; charset=utf-8", "parquet": "application/vnd.apache.parquet"}
PARAMETER_KINDS = {
    "toml": (params.to_toml, "application/toml; charset=utf-8"),
    "csv": (params.to_csv, KINDS["csv"]),
}


# ---- the page's files ----


class PageFile(NamedTuple):
    """One file of the gateway's web page."""

    body: bytes
    media_type: str
    etag: str


class PageFiles:
    """The page's files in a folder and its subfolders, by relative path.

    They are read into memory at the first request, so later requests do not wait for a disk.
    """

    def __init__(self, folder: Path = PAGE) -> None:
        self._folder = folder
        self._files: dict[str, PageFile] = {}

    async def index(self, request: Request) -> Response:
        """Return index.html. Raises Denied if the page is not installed, Hung if the disk hangs."""
        return await self._respond(request, INDEX)

    async def file(self, request: Request) -> Response:
        """Return the file that the path names. Raises Denied if there is none, Hung if the disk hangs."""
        return await self._respond(request, request.path_params["name"])

    async def _respond(self, request: Request, name: str) -> Response:
        if not self._files:
            read = partial(read_files, self._folder)
            self._files = await supervisor().within("page files", READ_S, read)
        found = self._files.get(name)
        if found is None and name == INDEX:
            raise Denied(404, "this installation of multidrop has no web page; use /api/plant or /metrics")
        if found is None:
            raise Denied(404, "unknown path")
        headers = {"etag": found.etag}
        if found.etag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return Response(found.body, media_type=found.media_type, headers=headers)


def read_files(folder: Path) -> dict[str, PageFile]:
    """Return the files of a folder by relative path, with slashes on all systems.

    Raises OSError if a file is unreadable.
    """
    found: dict[str, PageFile] = {}
    for path in sorted(folder.rglob("*")):
        if path.name == TEXTS:
            found |= _texts_by_language(path.read_text("utf-8"))
        elif path.is_file():
            media_type = TYPES.get(path.suffix, "text/plain")
            found[path.relative_to(folder).as_posix()] = _page_file(path.read_bytes(), media_type)
    return found


def _texts_by_language(catalogue: str) -> dict[str, PageFile]:
    """Return a JSON file for each language, such as texts.ru.json: translations by their English text."""
    texts: dict[str, dict[str, str]] = defaultdict(dict)
    for english, translations in tomllib.loads(catalogue).items():
        for language, text in translations.items():
            texts[language][english] = text
    return {
        f"texts.{language}.json": _page_file(json.dumps(found, ensure_ascii=False).encode(), TYPES[".json"])
        for language, found in texts.items()
    }


def _page_file(body: bytes, media_type: str) -> PageFile:
    return PageFile(body, media_type, f'"{hashlib.sha256(body).hexdigest()[:32]}"')


# ---- exports of the history, and parameters ----


class Exports:
    """The downloads of recorded values that are in progress."""

    def __init__(self) -> None:
        self.under_way = 0

    async def respond(
        self, part: Any, names: Sequence[str], begin: int, end: int, kind: str, *, is_gzipped: bool = False
    ) -> Response:
        """Start a download of recorded values from the historian `part`, and return its response.

        With `is_gzipped`, it is compressed for transfer. Raises Hung if the disk hangs, and Denied for wrong
        arguments or too many exports.
        """
        if kind not in KINDS:
            raise Denied(400, f"format = {kind[:20]!r} is neither csv nor parquet")
        if self.under_way >= MOST_EXPORTS:
            raise Denied(503, f"{MOST_EXPORTS} exports are under way: try again when one has ended")
        self.under_way += 1
        try:
            name = f"{_what(names)} {_moment(begin)} to {_moment(end)}.{kind}"
            headers = attachment(name) | {"vary": "accept-encoding"}
            pieces = await _in_thread(partial(part.export, names, begin, end, kind))
            if is_gzipped:
                pieces = _gzipped(pieces)
                headers["content-encoding"] = "gzip"
            return _Export(self, pieces, kind, headers)
        except BaseException as failure:
            self.under_way -= 1
            if isinstance(failure, ValueError):
                raise Denied(400, str(failure)) from failure
            raise


class _Export(StreamingResponse):
    """One download of recorded values. It ends when the client has the whole file or has disconnected."""

    def __init__(
        self, exports: Exports, pieces: Iterator[bytes], kind: str, headers: Mapping[str, str]
    ) -> None:
        super().__init__(_through(pieces), media_type=KINDS[kind], headers=headers)
        self._exports = exports

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._exports.under_way -= 1


def parameter_file(read: ParameterRead, kind: str) -> Response:
    """Return a drive's parameters as a TOML or CSV file. Raises Denied for another format."""
    if read.found is None or kind not in PARAMETER_KINDS:
        raise Denied(400, f"format = {kind[:20]!r} is neither toml nor csv")
    make, media_type = PARAMETER_KINDS[kind]
    name = f"{_what([f'{read.drive.name}.'])} {read.found.saved.replace(':', '-')}.{kind}"
    return Response(make(read.found, type(read.drive)), media_type=media_type, headers=attachment(name))


def attachment(name: str) -> dict[str, str]:
    """Return the header that makes a browser save an answer as a file of this name."""
    plain = name.encode("ascii", "replace").decode().replace("?", "_")
    return {"content-disposition": f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name)}"}


def _gzipped(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """Compress the pieces into one gzip stream, and yield this stream in fewer, larger pieces."""
    stream = zlib.compressobj(wbits=31)
    try:
        for piece in pieces:
            if made := stream.compress(piece):
                yield made
        yield stream.flush()
    finally:
        if isinstance(pieces, Generator):
            pieces.close()


async def _through(pieces: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Yield the pieces of a file, each made in a thread because the disk may hang."""
    try:
        while (piece := await _in_thread(partial(next, pieces, None))) is not None:
            yield piece
    finally:  # the iterator's end removes temporary files, also if the client has disconnected
        if isinstance(pieces, Generator):
            supervisor().thread("exports", PIECE_S, pieces.close)


async def _in_thread(work: Callable[[], R]) -> R:
    return await supervisor().within("exports", PIECE_S, work, most=MOST_EXPORTS)


def _what(names: Sequence[str]) -> str:
    """Return the drives' names in these series, with characters that are allowed in file names."""
    drives = list(dict.fromkeys(name.rpartition(".")[0] for name in names))
    if not drives:
        return "all drives"
    first = names[0] if len(names) == 1 else drives[0]
    more = f" and {len(drives) - 1} more" if len(drives) > 1 else ""
    return f"{FORBIDDEN.sub('_', first)[:MOST_NAME]}{more}"


def _moment(ms: int) -> str:
    """Return a UTC time for a file name, without colons, which some systems forbid."""
    return f"{iso_time(ms)[:19].replace(':', '-')}Z"
