"""Other rules: gateways of versions that say by other rules whose a line is. Beside them none is taken.

So when a fleet's version changes no line has two masters: the new gateways wait until the old are stopped.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from multidrop.fleet.leases.observer import Observer
from multidrop.fleet.leases.rules import RULES

UNSAID = 1  # the rules of who says none

_log = logging.getLogger("multidrop.fleet")


class OtherRules:
    """The other `gateways` that live by other rules than ours, by what their sessions say."""

    def __init__(self, me: str, observer: Observer) -> None:
        self.gateways: frozenset[str] = frozenset()
        self._me = me
        self._observer = observer

    def look(self, present: Mapping[str, Mapping[str, Any]]) -> None:
        """Note who there is of those with a session.

        One that is renewed no more does not count, though nobody may have ended it yet.
        """
        others = {name for name, value in present.items() if value.get("rules", UNSAID) != RULES}
        found = frozenset(others - {self._me} - self._observer.dead(others).keys())
        if found != self.gateways:
            self.gateways = found
            _log.warning("%s", self.trouble or "no gateway with other rules is left")

    @property
    def trouble(self) -> str:
        """Return the sentence about them; "" where there are none."""
        if not self.gateways:
            return ""
        names = ", ".join(sorted(self.gateways))
        return f"another version of multidrop runs in this fleet: no line is taken until {names} is stopped"
