"""Units in expressions: their dimensions, and the factors that convert between units of one dimension.

A unit that is not listed here, such as "pulses", has a dimension of its own. So has a revolution: 1 rpm is
not 1/60 Hz, and torque times speed in rpm is a power only with the factor 2 pi.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

Dimensions = tuple[tuple[str, int], ...]  # exponent of each base unit, sorted by unit; none is 0


class ValueUnit(NamedTuple):
    """A unit: the product of `factor` and of base units with exponents."""

    text: str
    factor: float = 1.0
    dimensions: Dimensions = ()

    def __str__(self) -> str:
        return self.text or "a number without a unit"

    def times(self, other: ValueUnit) -> ValueUnit:
        """Return the unit of a product. Raises ValueError if its factor is too large or too small."""
        return self._combined(other, 1)

    def per(self, other: ValueUnit) -> ValueUnit:
        """Return the unit of a quotient. Raises ValueError if its factor is too large or too small."""
        return self._combined(other, -1)

    def _combined(self, other: ValueUnit, sign: int) -> ValueUnit:
        exponents = dict(self.dimensions)
        for base, exponent in other.dimensions:
            exponents[base] = exponents.get(base, 0) + sign * exponent
        dimensions = tuple(sorted((base, n) for base, n in exponents.items() if n))
        if not other.text:
            text = self.text
        elif sign > 0:
            text = f"{self.text}*{other.text}" if self.text else other.text
        else:
            text = f"{self.text or '1'}/{other.text.translate(_INVERTED)}"
        factor = self.factor * other.factor if sign > 0 else self.factor / other.factor
        if not _LEAST_FACTOR < factor < 1 / _LEAST_FACTOR:
            raise ValueError(f"the unit {text:.40} is too large or too small")
        return ValueUnit(text, factor, dimensions)

    def is_like(self, other: ValueUnit) -> bool:
        """Return True if values in one unit can be converted to the other."""
        return self.dimensions == other.dimensions


_INVERTED = str.maketrans("*·/", "//*")  # for a division by a/b: divides by a and multiplies by b
_LEAST_FACTOR = 1e-150  # smallest factor of a unit, so that products and quotients of units stay finite
NUMBER = ValueUnit("")
SECOND = ValueUnit("s", 1.0, (("s", 1),))

_WATT = {"kg": 1, "m": 2, "s": -3}
_VOLT = {**_WATT, "A": -1}
_JOULE = {"kg": 1, "m": 2, "s": -2}
_NEWTON = {"kg": 1, "m": 1, "s": -2}
_PASCAL = {"kg": 1, "m": -1, "s": -2}
_KNOWN: dict[str, tuple[float, Mapping[str, int]]] = {
    "": (1.0, {}),
    "1": (1.0, {}),
    "%": (0.01, {}),
    **{name: (s, {"s": 1}) for name, s in (("us", 1e-6), ("ms", 1e-3), ("s", 1.0))},
    **{name: (s, {"s": 1}) for name, s in (("min", 60.0), ("h", 3600.0), ("d", 86400.0))},
    **{name: (hz, {"s": -1}) for name, hz in (("Hz", 1.0), ("kHz", 1e3))},
    "rev": (1.0, {"rev": 1}),
    "rpm": (1 / 60, {"rev": 1, "s": -1}),
    **{name: (a, {"A": 1}) for name, a in (("mA", 1e-3), ("A", 1.0))},
    **{name: (v, _VOLT) for name, v in (("mV", 1e-3), ("V", 1.0), ("kV", 1e3))},
    **{name: (w, _WATT) for name, w in (("W", 1.0), ("VA", 1.0), ("kW", 1e3), ("kVA", 1e3), ("MW", 1e6))},
    "Ohm": (1.0, {**_VOLT, "A": -2}),
    **{name: (j, _JOULE) for name, j in (("J", 1.0), ("kJ", 1e3), ("MJ", 1e6))},
    **{name: (j, _JOULE) for name, j in (("Wh", 3.6e3), ("kWh", 3.6e6), ("MWh", 3.6e9))},
    **{name: (n, _NEWTON) for name, n in (("N", 1.0), ("kN", 1e3))},
    **{name: (nm, _JOULE) for name, nm in (("Nm", 1.0), ("kNm", 1e3))},
    **{name: (pa, _PASCAL) for name, pa in (("Pa", 1.0), ("kPa", 1e3), ("MPa", 1e6), ("mbar", 1e2))},
    **{name: (pa, _PASCAL) for name, pa in (("bar", 1e5), ("atm", 101_325.0), ("kgf/cm²", 98_066.5))},
    **{name: (m, {"m": 1}) for name, m in (("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), ("km", 1e3))},
    **{name: (m3, {"m": 3}) for name, m3 in (("l", 1e-3), ("L", 1e-3))},
    **{name: (kg, {"kg": 1}) for name, kg in (("g", 1e-3), ("kg", 1.0), ("t", 1e3))},
}
_POWER = re.compile(r"([^\W\d]+)([23²³])")
_EXPONENTS = {"2": 2, "3": 3, "²": 2, "³": 3}


KNOWN_UNITS = tuple(_KNOWN)


@lru_cache(maxsize=1024)
def unit_of(text: str) -> ValueUnit:
    """Return the unit of a text such as "kWh", "m3/h" or "kg*m/s2"."""
    if text in _KNOWN:
        return _unit(text, text)
    product, sign = NUMBER, 1
    for part in re.split(r"([*·/])", text):
        if part in ("*", "·", "/"):
            sign = -1 if part == "/" else 1
        else:
            unit = _power(part.strip())
            product = product.times(unit) if sign > 0 else product.per(unit)
    return product._replace(text=text)


def _power(text: str) -> ValueUnit:
    """Return the unit of a text such as "m3", a unit with an exponent."""
    match = _POWER.fullmatch(text)
    if match is None or text in _KNOWN:
        return _unit(text, text)
    base = _unit(match[1], match[1])
    square = base.times(base)
    return square if _EXPONENTS[match[2]] == 2 else square.times(base)


def _unit(text: str, name: str) -> ValueUnit:
    factor, exponents = _KNOWN.get(name, (1.0, {name: 1}))
    return ValueUnit(text, factor, tuple(sorted(exponents.items())))


# nanometre, knot, siemens and molar, which are not misspelled Nm, kN, ms, us and mm
_OTHER_UNITS = frozenset({"nm", "kn", "mS", "uS", "mM"})


def misspelled_unit(text: str) -> str:
    """Return a hint if a unit in this text has wrong upper or lower case, such as "KW" for "kW"; else ""."""
    for part in re.split(r"[*·/]", text):
        name = part.strip()
        match = _POWER.fullmatch(name)
        name = match[1] if match and name not in _KNOWN else name
        if name in _KNOWN or name in _OTHER_UNITS or len(name) < 2:
            continue
        for known in KNOWN_UNITS:
            # milli and mega are different units, such as mW and MW
            is_prefix = known[:1] in "mM" and known[1:] == name[1:] in _KNOWN
            if known.lower() == name.lower() and not is_prefix:
                return f'the unit {name} is not known; did you mean "{known}"?'
    return ""
