"""Titles of registers in other languages: the catalogue, and the choice of a language."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files

LANGUAGES = ("ru", "zh")  # languages of the catalogue, besides English
ENGLISH = "en"
_CODE = re.compile(r"[A-Za-z]{2}(?![A-Za-z])")  # the language in a tag such as ru-RU, or ru_RU.UTF-8


@cache
def catalogue(language: str) -> Mapping[str, str]:
    """Return the titles in a language, by the register's name; none for English or an unknown language."""
    if language not in LANGUAGES:
        return {}
    file = files("multidrop.drive") / "catalogue" / f"{language}.toml"
    return tomllib.loads(file.read_text("utf-8"))


def chosen_language(tags: Iterable[str]) -> str:
    """Return the first language of these tags in which titles are known; English if there is none.

    A tag is such as `ru`, `zh-CN` or `ru_RU.UTF-8`.
    """
    codes = (match[0].lower() for tag in tags if (match := _CODE.match(tag.strip())))
    return next((code for code in codes if code in (*LANGUAGES, ENGLISH)), ENGLISH)
