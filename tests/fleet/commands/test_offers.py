"""Offers of a command whose drive has left its line since."""

from __future__ import annotations

from multidrop import InvtCHE
from multidrop.fleet.commands.messages import CommandOutcome, CommandRequest
from multidrop.fleet.commands.offers import prepare


def test_a_command_to_a_drive_that_has_left_its_line_was_not_sent() -> None:
    drive = InvtCHE(1, name="mill", maximum_frequency=50)
    for request in (
        CommandRequest("1", "anna", "mill", register="setpoint", value=10.0),
        CommandRequest("2", "anna", "mill", verb="start"),
    ):
        answer = prepare(drive, request).work()
        assert answer.outcome is CommandOutcome.NOT_SENT
        assert answer.text.startswith("mill is ")


def test_an_offer_forgets_nothing_of_the_setpoint_in_force() -> None:
    """It is not sent yet, and perhaps never: a start would be refused, or not see a power cycle."""
    drive = InvtCHE(1, name="mill", maximum_frequency=50)
    drive.commanded = 40.0
    prepare(drive, CommandRequest("1", "anna", "mill", verb="set_frequency", options={"hz": 10.0}))
    assert drive.commanded == 40.0
