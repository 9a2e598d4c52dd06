"""Failures of a fleet's servers."""

from __future__ import annotations


class FleetError(OSError):
    """Tell a user, in one sentence, why the fleet's servers cannot be used."""


class TooOld(FleetError):
    """A server that may give one lease to two gateways."""


class NotAdmitted(FleetError):
    """A server that does not believe us, or that we do not believe."""


class NoRight(FleetError):
    """A request that these credentials do not allow, or whose answer they do not allow to hear."""


class NotDelivered(FleetError):
    """A request that reached nobody, for certain."""


class MayNotSend(NoRight, NotDelivered):
    """A request that the server did not pass on, for want of rights."""


class NobodyThere(NotDelivered):
    """A request of which the server says that nobody takes it."""


class Unsure(FleetError):
    """A request without an answer in time: it may have been carried out, or still be."""


class Conflict(Exception):
    """A record that has another revision than the one that was to be replaced."""
