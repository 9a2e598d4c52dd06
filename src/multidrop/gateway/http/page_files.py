"""The files of the web page, read into memory at the first request. Later requests do not wait for a disk.

The catalogue of translations is served as one file for each language, because a viewer needs only one.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import NamedTuple

from starlette.requests import Request
from starlette.responses import Response

from multidrop.gateway.http.messages import Denied
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


class PageFile(NamedTuple):
    """One file of the page."""

    body: bytes
    media_type: str
    etag: str


class PageFiles:
    """The files of a folder and of the folders in it, by relative path."""

    def __init__(self, folder: Path = PAGE) -> None:
        self._folder = folder
        self._files: dict[str, PageFile] = {}

    async def index(self, request: Request) -> Response:
        """Return index.html. Raises Denied if this installation has no page, Hung if the disk hangs."""
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
            raise Denied(404, "this version of multidrop has no page; /api/plant and /metrics are there")
        if found is None:
            raise Denied(404, "unknown path")
        headers = {"etag": found.etag}
        if found.etag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return Response(found.body, media_type=found.media_type, headers=headers)


def read_files(folder: Path) -> dict[str, PageFile]:
    """Return the files by relative path, which always has slashes. Raises OSError if one is unreadable."""
    found: dict[str, PageFile] = {}
    for path in sorted(folder.rglob("*")):
        if path.name == TEXTS:
            found |= _texts_by_language(path.read_text("utf-8"))
        elif path.is_file():
            media_type = TYPES.get(path.suffix, "text/plain")
            found[path.relative_to(folder).as_posix()] = _page_file(path.read_bytes(), media_type)
    return found


def _texts_by_language(catalogue: str) -> dict[str, PageFile]:
    """Return a JSON file for each language, such as texts.ru.json: the translations by English text."""
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
