"""Verb rules: the rights that each verb needs which a gateway carries out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from multidrop.gateway.http.rights import Right


class VerbRule(NamedTuple):
    """The role that a verb needs, and whether it must stand in the `verbs` of [serve.may]."""

    role: Right
    is_listed: bool


VERBS: Mapping[str, VerbRule] = {
    "start": VerbRule(Right.WRITE, True),
    "jog": VerbRule(Right.WRITE, True),
    "reset_fault": VerbRule(Right.WRITE, True),
    "set_frequency": VerbRule(Right.WRITE, True),
    "coast": VerbRule(Right.STOP, True),
    "emergency_stop": VerbRule(Right.STOP, True),
    "stop": VerbRule(Right.STOP, False),
}
STOPPING = frozenset(verb for verb, rule in VERBS.items() if rule.role is Right.STOP)
