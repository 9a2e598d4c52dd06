"""Failures of a fleet's servers."""

from __future__ import annotations


class FleetError(OSError):
    """Tell a user, in one sentence, why the fleet's servers cannot be used."""


class TooOld(FleetError):
    """A server that may give one lease to two gateways."""


class NotAdmitted(FleetError):
    """A server that does not believe us, or that we do not believe."""


class NoRight(FleetError):
    """A request that these credentials do not allow: it was certainly not carried out."""


class Unsure(FleetError):
    """A request without an answer in time: it may have been carried out, or still be."""


class Conflict(Exception):
    """A record that has another revision than the one that was to be replaced."""
