"""Settings that several receivers of rows share: the spool, a URL, and files with secrets."""

from __future__ import annotations

from collections.abc import Iterator
from urllib.parse import parse_qs, urlsplit

from multidrop import Plant
from multidrop.gateway.settings import input_file
from multidrop.printable import masked
from multidrop.recording import parse_size

SECRETS = ("p", "u", "token", "password", "api_key", "apikey", "key")  # query parameters with secrets
MOST_SECRET = 4096  # limit, in bytes, of the size of a file with a secret


def spool_mistakes(most: str) -> Iterator[str]:
    """Yield a sentence if `most` is not a size."""
    try:
        parse_size(most)
    except ValueError as mistake:
        yield f"most = {mistake}"


def url_mistakes(url: str, example: str) -> Iterator[str]:
    """Yield a sentence if this is not an http:// or https:// URL, or if the URL contains a secret."""
    try:
        parts = urlsplit(url)
        host, user = parts.hostname, parts.username
        is_valid = url.isascii() and url.isprintable() and " " not in url and parts.port != 0
    except ValueError:
        parts, host, user, is_valid = urlsplit(""), None, None, False
    if user is not None or set(parse_qs(parts.query)) & {*SECRETS}:
        yield 'url has a login in it; write token = "FILE" instead'
    elif parts.scheme not in ("http", "https") or not host or not is_valid:
        yield f'url = "{masked(url)}" is not a URL; write url = "{example}"'


def secret_mistakes(key: str, name: str, plant: Plant) -> Iterator[str]:
    """Yield a sentence if the file with a secret cannot be read, or does not have exactly one line."""
    try:
        secret = secret_in(name, plant)
        if name and len(secret.splitlines()) != 1:
            yield f'{key} = "{name}": {input_file(name, plant)} has {len(secret.splitlines())} lines, not one'
    except OSError as failure:
        yield f'{key} = "{name}": {input_file(name, plant)} cannot be read: {failure.strerror}'


def secret_in(name: str, plant: Plant) -> str:
    """Return the secret in a file: one of the systemd service's credentials, or a file beside the plant file.

    Raises OSError. If `name` is "", return "".
    """
    if not name:
        return ""
    with input_file(name, plant).open("rb") as file:
        return file.read(MOST_SECRET).decode("utf-8", "replace").strip()


def host_of(url: str) -> str:
    """Return the scheme and host of a URL, for logs."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.hostname}"
