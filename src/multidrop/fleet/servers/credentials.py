"""Credentials: the identity of a NATS connection, and the servers that it trusts.

A user's key is an Ed25519 key pair (an "nkey"). The secret key is in a file that only its user has; servers
know the public key. Answers to a user go to an inbox that is named after the public key. No other user may
read the inbox.
"""

from __future__ import annotations

import os
import ssl
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SEED = "SU"  # prefix of a user's secret key
CREDS = "-----BEGIN NATS USER JWT-----"


def new_seed() -> str:
    import nkeys

    return bytes(nkeys.encode_seed(os.urandom(32), nkeys.PREFIX_BYTE_USER)).decode()


def public_key(seed: str) -> str:
    """Return the public key that belongs to a secret key. Raises ValueError for an invalid key."""
    import nkeys

    try:
        pair = nkeys.from_seed(bytearray(seed.encode()))
    except (nkeys.NkeysError, ValueError) as failure:
        raise ValueError(f"not a secret key of a NATS user: {type(failure).__name__}") from None
    return bytes(pair.public_key).decode()


def inbox_of(public: str) -> str:
    return f"_INBOX_{public}"


def connect_options(
    urls: Sequence[str], credentials: Path | None = None, ca: Path | None = None
) -> dict[str, Any]:
    """Return nats-py's options for connecting to these servers.

    `credentials` is a file with a user's secret key, or a .creds file. `ca` is the certificate that has
    signed the servers' certificates. With `ca`, or with tls:// in a URL, TLS starts before anything else is
    sent. Raises ValueError for an invalid file.
    """
    options: dict[str, Any] = {}
    if ca is not None or any(url.startswith("tls://") for url in urls):
        options |= {"tls": _context(ca), "tls_handshake_first": True}
    return options | _user(credentials) if credentials is not None else options


def _user(credentials: Path) -> dict[str, Any]:
    try:
        text = credentials.read_text("utf-8", "replace").strip()
    except OSError as failure:
        raise ValueError(f"{credentials}: {failure.strerror}") from None
    if CREDS in text:
        return {"user_credentials": str(credentials)}
    if not text.startswith(SEED):
        raise ValueError(f"{credentials} has no credentials: name a key of `fleet rights`, or a .creds file")
    try:
        public = public_key(text)
    except ValueError:
        raise ValueError(f"{credentials} is not a valid key of `fleet rights`") from None
    return {"nkeys_seed_str": text, "inbox_prefix": inbox_of(public)}


def _context(ca: Path | None) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=ca)
    except ssl.SSLError:
        raise ValueError(f"{ca} has no certificate: it must be a PEM file") from None
    except OSError as failure:
        raise ValueError(f"{ca}: {failure.strerror}") from None
