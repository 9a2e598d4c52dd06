"""The page's files over HTTP: types, ETags, and paths outside the page's folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from gateways import served

from multidrop.gateway.http import page_files

TYPES = {
    "/": "text/html; charset=utf-8",
    "/page/app.js": "text/javascript; charset=utf-8",
    "/page/style.css": "text/css; charset=utf-8",
    "/page/icon.svg": "image/svg+xml",
    "/page/vendor/uPlot-LICENSE": "text/plain; charset=utf-8",
}


def test_page_files_have_types_and_a_known_etag_is_answered_with_304(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        for path, media_type in TYPES.items():
            answer = gateway.get(path)
            assert (answer.status, answer.headers["content-type"]) == (200, media_type)
            again = gateway.get(path, if_none_match=answer.headers["etag"])
            assert (again.status, again.body, again.headers["cache-control"]) == (304, b"", "no-cache")
            head = gateway.request("HEAD", path)
            assert (head.status, head.headers["content-length"]) == (200, str(len(answer.body)))


def test_files_outside_the_page_folder_are_not_served(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        for name in ("", "app", "../gateway.py", "%2e%2e/gateway.py", "vendor", "/etc/passwd"):
            answer = gateway.get(f"/page/{name}")
            assert (answer.status, answer.json) == (404, {"error": "unknown path"}), name


def test_installation_without_a_page_answers_404(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_files.PageFiles.__init__, "__defaults__", (tmp_path / "missing",))
    with served(tmp_path) as gateway:
        assert "this version of multidrop has no page" in gateway.get("/").json["error"]
        assert gateway.get("/api/plant").status == 200
