"""Parse YAML, numbers, number types and byte orders in other programs' register tables."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from multidrop.printable import install_command

# ---- numbers ----


TABLES = ("holding", "input", "coil", "discrete")
_SIGNED = {"8": "I8", "16": "I16", "32": "I32", "64": "I64"}
_UNSIGNED = {"16": "U16", "32": "U32", "64": "U64"}
_FLOATS = {"": "F32", "16": "F16", "32": "F32", "64": "F64"}
_KINDS: Mapping[str, Mapping[str, str]] = {
    **dict.fromkeys(("int", "s", "i", "sint", "signed", "acc_s"), _SIGNED),
    **dict.fromkeys(("uint", "u", "unsigned", "acc", "enum", "bitfield", "bitmap"), _UNSIGNED),
    **dict.fromkeys(("float", "f", "fp", "real"), _FLOATS),
    "bcd": {"16": "BCD16", "32": "BCD32"},
}
_NAMED = {"word": "U16", "dword": "U32", "lword": "U64", "double": "F64", "lreal": "F64", "short": "I16"}
# type names of IEC 61131
_NAMED |= {"ushort": "U16", "dint": "I32", "udint": "U32", "lint": "I64", "ulint": "U64"}
_NAMED |= {"sunssf": "I16", "count": "U16", "pad": "U16", "raw16": "U16"}
_ANY_WIDTH = {"int": "I", "signed": "I", "uint": "U", "unsigned": "U", "bcd": "BCD"}
_ANY_WIDTH |= dict.fromkeys(("enum", "bitfield", "bitmap", "hex"), "U")
_REAL = re.compile(r"[+-]?(?:[0-9]{1,400}[.]?[0-9]{0,400}|[.][0-9]{1,400})(?:[eE][+-]?[0-9]{1,9})?")
_WHOLE = re.compile(r"0[xX][0-9a-fA-F]{1,16}|-?[0-9]{1,20}")


def number_format(kind: str) -> str | None:
    """Return the number format of a type such as uint16, s32 or float; None for unknown types."""
    kind = kind.strip().lower()
    if kind in _NAMED:
        return _NAMED[kind]
    match = re.fullmatch(r"([a-z_]+?)(\d*)", kind)
    return _KINDS.get(match[1], {}).get(match[2]) if match else None


def format_of_width(kind: str, words: int) -> str | None:
    """Return the number format of a type such as int with a width of `words` words; None if unknown."""
    letter = _ANY_WIDTH.get(kind.strip().lower())
    return f"{letter}{16 * words}" if letter and words in (1, 2, *((4,) if letter != "BCD" else ())) else None


def words_of(number: str) -> int:
    return {"32": 2, "64": 4}.get(number[-2:], 1)


def bits_text(low: int, high: int) -> str:
    """Return a range of bits in the notation of family files, such as 3 or 0-7."""
    return str(low) if low == high else f"{low}-{high}"


def put_number(details: dict[str, Any], number: str, order: str = "") -> None:
    """Set the number format, and the byte order of a four-byte number, such as "CDAB", in `details`."""
    if number != "U16":
        details["number_format"] = number
    if words_of(number) == 1:
        order = "BA" if order in ("BADC", "DCBA", "BA") else ""
    if order not in ("", "ABCD"):
        details["order"] = order


def scaled(details: dict[str, Any], step: Any, offset: Any = 0) -> None:
    """Set `step` and `offset` in `details`, except a step of 1 or an offset of 0, which have no effect.

    A step of 0 means that no step is given.

    Raises ValueError if `step` or `offset` is not a number.
    """
    step, offset = number(step, 1, "scale"), number(offset, 0, "offset")
    if step not in (0, 1):
        details["step"] = step
    if offset:
        details["offset"] = offset


def number(given: Any, default: float, key: str = "number") -> float:
    """Return a number, which may be given as text. Return `default` if `given` is None or empty.

    Raises ValueError for any other value.
    """
    if given in (None, ""):
        return default
    text = str(given).strip()
    if re.fullmatch(r"-?[0-9]+,[0-9]+", text):  # a number with a decimal comma
        text = text.replace(",", ".")
    found = float(text) if _REAL.fullmatch(text) else math.nan
    if not math.isfinite(found):
        raise ValueError(f"{key} = {str(given)[:40]!r} is not a number")
    return int(found) if found == int(found) and abs(found) < 1e15 else found


def whole(entry: Mapping[str, Any], key: str, default: int | None = None) -> int:
    """Return the whole number of a key, which may be decimal or hex text.

    Raises KeyError if the key is missing and there is no default, ValueError if it is not a whole number.
    """
    given = entry.get(key)
    if given is None:
        if default is None:
            raise KeyError(key)
        return default
    text = str(given).strip()
    if isinstance(given, bool) or not isinstance(given, (int, str)) or not _WHOLE.fullmatch(text):
        raise ValueError(f"{key} = {str(given)[:40]!r} is not a whole number")
    return int(text, 16) if text[:2].lower() == "0x" else int(text)


def count(given: Any, key: str = "count") -> int | str:
    """Return a raw count, or "NaN". A text may be decimal or hex. Raises ValueError for other values."""
    return "NaN" if str(given).strip().lower() in ("nan", ".nan") else whole({key: given}, key)


def float_of_bits(bits: int, number: str) -> float | str:
    """Return the float with these bits, or "NaN". Raises ValueError if `bits` is too large for the format."""
    code, size = {"F16": (">e", 2), "F32": (">f", 4), "F64": (">d", 8)}[number]
    try:
        (found,) = struct.unpack(code, bits.to_bytes(size))
    except OverflowError:
        raise ValueError(f"{bits:#x} has more bits than {number}") from None
    return "NaN" if math.isnan(found) else float(found)


# ---- YAML ----


MOST_CHARACTERS = 1_000_000
MOST_NODES = 50_000  # limit of nodes; an alias counts as many nodes as it expands to


class YamlTag(str):
    """A value with a tag such as `!secret host`, as text. The real value is not in the file."""


def parse_yaml(text: str) -> Any:
    """Return the document. A value with a tag such as !secret becomes a `YamlTag`.

    Raises ImportError if PyYAML is missing, ValueError if the text is invalid or too long, or expands to too
    many nodes.
    """
    try:
        yaml: Any = import_module("yaml")
    except ImportError as failure:
        raise ImportError(f"reading YAML needs PyYAML; install it: {install_command('yaml')}") from failure
    if len(text) > MOST_CHARACTERS:
        raise ValueError(f"the file has more than {MOST_CHARACTERS} characters of YAML")

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Limits the number of nodes."""

        left = MOST_NODES

        def compose_node(self, parent: Any, index: Any) -> Any:
            is_alias = self.check_event(yaml.AliasEvent)
            node = super().compose_node(parent, index)
            self.left -= 1
            if is_alias:
                self.count_again(node)
            if self.left < 0:
                raise ValueError(
                    f"the file has more than {MOST_NODES} entries, if each alias is replaced by its entries"
                )
            return node

        def count_again(self, node: Any) -> None:
            """Count the nodes that an alias expands to, up to the limit."""
            pending = [node]
            while pending and self.left >= 0:
                self.left -= 1
                value = pending.pop().value
                if isinstance(value, list):
                    pending += [
                        each for pair in value for each in (pair if isinstance(pair, tuple) else (pair,))
                    ]

    Loader.add_multi_constructor("!", lambda loader, suffix, node: YamlTag(_spelt(suffix, node.value)))
    try:
        return yaml.load(text, Loader)
    except yaml.YAMLError as failure:
        raise ValueError(f"the file is not YAML: {' '.join(str(failure).split())[:300]}") from failure
    except RecursionError as failure:
        raise ValueError("the file is YAML that is nested too deeply") from failure


def _spelt(suffix: str, value: Any) -> str:
    return f"!{suffix} {value}"[:100] if isinstance(value, str) else f"!{suffix}"
