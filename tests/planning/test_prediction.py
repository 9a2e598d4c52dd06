"""Predictions: compared with manually counted frame lengths and with the core, and invariants of any line."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from line_driver import LineDriver

from multidrop.core import Peer, build_reply
from multidrop.drive import Drive, Framing
from multidrop.drive.register import HOLDING, reading
from multidrop.families import MODELS, YD1000, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.planning import prediction
from multidrop.planning.blocks import Planned, planned
from multidrop.planning.bus_time import in_order
from multidrop.planning.prediction import LATENESS
from multidrop.planning.prediction import predict as predict_with_host
from multidrop.planning.schedule import TURN_SHARE
from multidrop.planning.suggestions import Suggestions, duration_text, suggest
from multidrop.sim import EncodedDrive
from multidrop.transport.prepared import make_exchange

BIT = 1 / 9600
predict = partial(predict_with_host, lateness=0.0)


class Simple(Drive):
    """A family whose four registers take two requests."""

    title = "SIMPLE"
    baudrates = (9600, 19200, 38400)
    most_registers = {HOLDING: 2}
    response_delay = 4e-3
    a = reading(1)
    b = reading(2)
    c = reading(11)
    d = reading(12)


OWN = (8 + 9) * 10 * BIT + 4e-3  # request and reply of two registers, 8N1
SILENCE = 3.5 * 10 * BIT + BIT


def asked(drive: Drive, every: float | None = None, *names: str) -> list[Planned]:
    registers = [drive.register(name) for name in names] or drive.readings()
    return planned(drive, [(register, every) for register in registers])


def test_a_cycle_is_characters_delays_and_silences() -> None:
    drives = [Simple(1, name="one", format="8N1"), Simple(2, name="two", format="8N1")]
    found = predict([each for drive in drives for each in asked(drive)])
    assert found.cycle == pytest.approx(4 * (OWN + SILENCE))
    assert found.utilisation == 1
    assert [(rate.requests, len(rate.registers)) for rate in found.rates] == [(2, 4), (2, 4)]
    assert [rate.reached for rate in found.rates] == pytest.approx([1 / found.cycle] * 2)
    assert found.exchanges_per_second(drives[0]) == pytest.approx(2 / found.cycle)


def test_equal_lines_are_simulated_only_once(monkeypatch: pytest.MonkeyPatch) -> None:
    begun = 0

    class CountedSchedule(prediction.Schedule[prediction.Job]):
        def __init__(self) -> None:
            nonlocal begun
            begun += 1
            super().__init__()

    monkeypatch.setattr(prediction, "Schedule", CountedSchedule)
    figures = [
        (found.cycle, found.utilisation, [(rate.every, rate.reached) for rate in found.rates])
        for delay, every in ((4.001e-3, 0.5), (4.001e-3, 0.5), (4.002e-3, 0.5), (4.001e-3, 0.6))
        for found in [predict(asked(one, every), {one: delay}) for one in [Simple(1, name="one")]]
    ]
    assert figures[0] == figures[1]
    assert figures[2] != figures[0] != figures[3]
    assert begun == 3


def test_a_prediction_includes_a_shorter_silence() -> None:
    usual, short = ErmanERG220(1), ErmanERG220(1, silence=500e-6)
    cycles = [predict(asked(each, None, "output_current")).cycle for each in (usual, short)]
    assert cycles[0] - cycles[1] == pytest.approx(1.25e-3)


def test_a_prediction_includes_10_ms_of_silence_before_and_after_an_ibd() -> None:
    """Two of three gaps have the IBD's silence, although the other drives' silence is shorter."""
    che, other, ibd = InvtCHE(1, format="8N1"), InvtCHE(2, format="8N1"), InnovertIBD(3)
    exchanges = [asked(one, None, "output_current") for one in (che, other, ibd)]
    found = predict([one for each in exchanges for one in each])
    own = 3 * (8 + 7) * 10 * BIT + 2 * che.response_delay + ibd.response_delay
    assert found.cycle == pytest.approx(own + 2 * (10e-3 + BIT) + SILENCE)


def test_each_switch_of_settings_adds_its_time() -> None:
    drives = [ErmanERG220(1), YD1000(2), ErmanERG220(3)]
    exchanges = [each for drive in drives for each in asked(drive, None, "output_frequency")]
    free, dear = predict(exchanges), predict(exchanges, switching=0.01)
    assert dear.cycle - free.cycle == pytest.approx(2 * 0.01)
    assert (free.switches, predict(asked(ErmanERG220(1))).switches) == (2, 0)


def test_a_prediction_for_a_network_port_includes_no_switching() -> None:
    drives = [InvtCHE(1, baudrate=9600), InvtCHE(2, baudrate=19200)]
    for drive in drives:
        drive.take_framing_of("tcp://10.0.0.7")
    exchanges = [each for drive in drives for each in asked(drive, None, "output_frequency")]
    assert predict(exchanges).switches == 0
    assert predict(exchanges, switching=0.01).cycle == predict(exchanges).cycle


def test_suggestions_include_the_switching_time() -> None:
    drives = [ErmanERG220(1), YD1000(2)]
    exchanges = [each for drive in drives for each in asked(drive, 0.06, "output_frequency")]
    periods = []
    for switching in (0.0, 0.05):
        found = suggest(exchanges, predict(exchanges, switching=switching), switching)
        periods.append(found.every[0][1])
        changed = [each for drive in drives for each in asked(drive, periods[-1], "output_frequency")]
        assert predict(changed, switching=switching).fits
    assert periods[1] > periods[0]


def test_measured_delays_replace_the_documented_delays() -> None:
    one, two = Simple(1), Simple(2)
    exchanges = [*asked(one), *asked(two)]
    assert predict(exchanges, {one: 9e-3}).cycle == pytest.approx(predict(exchanges).cycle + 2 * 5e-3)


def test_registers_without_a_period_get_the_time_that_slow_rates_leave() -> None:
    timed, eager = Simple(1, format="8N1"), Simple(2, format="8N1")
    found = predict([*asked(timed, 0.1), *asked(eager)])
    load = 2 * (OWN + SILENCE) / 0.1
    assert [rate.reached for rate in found.rates] == pytest.approx([10, (1 - load) / (2 * (OWN + SILENCE))])
    assert found.fits
    assert predict(asked(timed, 0.1)).utilisation == pytest.approx(load)


def test_a_rate_that_is_too_high_reaches_what_the_line_allows() -> None:
    drives = [Simple(address, format="8N1") for address in range(1, 5)]
    found = predict([each for drive in drives for each in asked(drive, 0.05)])
    assert found.utilisation == pytest.approx(8 * (OWN + SILENCE) / 0.05)
    assert not found.fits
    assert [rate.reached for rate in found.rates] == pytest.approx([1 / found.cycle] * 4, rel=0.01)


def test_a_drive_without_a_period_keeps_its_share_of_an_overloaded_line() -> None:
    hasty, eager = Simple(1, name="hasty", format="8N1"), Simple(2, name="eager", format="8N1")
    found = predict([*asked(hasty, 0.02), *asked(eager)])
    assert [(rate.drive.name, rate.fits) for rate in found.rates] == [("hasty", False), ("eager", True)]
    assert found.rates[1].reached == pytest.approx(TURN_SHARE / (2 * (OWN + SILENCE)))
    assert found.rates[0].reached == pytest.approx((1 - TURN_SHARE) / (2 * (OWN + SILENCE)), rel=0.01)


def test_a_prediction_adds_the_hosts_lateness_to_each_exchange() -> None:
    exchanges = [*asked(Simple(1)), *asked(Simple(2))]
    assert predict_with_host(exchanges).cycle == pytest.approx(predict(exchanges).cycle + 4 * LATENESS)


# ---- compared with the core's line, on a clock that the test sets ----


def carried_out(exchanges: Sequence[Planned]) -> float:
    """Return the seconds of a bus cycle of the core in which every drive has its documented delay."""
    drives = in_order(dict.fromkeys(exchange.drive for exchange in exchanges))
    order = [exchange for drive in drives for exchange in exchanges if exchange.drive is drive]
    peers = {each: Peer(least_timeout=0.02, most_timeout=each.response_timeout) for each in drives}
    made = [make_exchange(each.drive, each.block.request, peers[each.drive]) for each in order]
    answers = [EncodedDrive(each.drive).answer(each.block.request, 0) for each in order]
    line = LineDriver()
    begun = []
    for _ in range(3):
        begun.append(line.now)
        for planned_, asked_, answer in zip(order, made, answers, strict=True):
            assert answer is not None
            reply = build_reply(planned_.drive.framing, answer)
            line.begin(asked_)
            request = line.wait_until_write()
            characters = len(request) + len(reply)
            own = characters * planned_.drive.settings.character + planned_.drive.response_delay
            line.now += round(own * 1e9)
            assert line.listens
            line.receive(reply)
            assert line.want == "done"
            assert line.completion.result == len(reply)
    return (begun[2] - begun[1]) / 1e9


@settings(max_examples=examples(25), deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(sorted(MODELS)), st.integers(0, 2), st.integers(1, 6)),
        min_size=1,
        max_size=8,
    )
)
def test_the_cores_line_takes_the_predicted_time(wanted: list[tuple[str, int, int]]) -> None:
    exchanges: list[Planned] = []
    for address, (model, framing, count) in enumerate(wanted, 1):
        family = MODELS[model]
        drive = family(address, framing=family.framings[framing % len(family.framings)])
        exchanges += planned(drive, [(reading, None) for reading in drive.readings()[:count]])
    assert carried_out(exchanges) == pytest.approx(predict(exchanges).cycle, rel=1e-5)


PERIODS = st.sampled_from([None, 0.02, 0.1, 0.5, 2.0])


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.story
@settings(max_examples=examples(40), deadline=None)
@given(st.lists(st.tuples(st.sampled_from(sorted(MODELS)), PERIODS), min_size=1, max_size=8))
def test_predicted_rates_never_need_more_than_the_lines_time(wanted: list[tuple[str, float | None]]) -> None:
    """The exchanges per second of all rates, even counted without silence, fit into a second."""
    exchanges: list[Planned] = []
    for address, (model, every) in enumerate(wanted, 1):
        drive = MODELS[model](address)
        exchanges += planned(drive, [(reading, every) for reading in drive.readings()[:4]])
    found = predict(exchanges)
    alone = {
        rate: predict([exchange for exchange in exchanges if exchange.drive is rate.drive]).cycle
        for rate in found.rates
    }
    assert sum(rate.reached * cycle for rate, cycle in alone.items()) <= 1.01
    for rate in found.rates:
        assert rate.every is None or rate.reached * rate.every <= 1.01


# ---- suggestions ----


def with_suggestion(drives: list[Drive], found: Suggestions, every: float, which: str) -> list[Planned]:
    if which == "every":
        ((old, new),) = found.every
        assert old == every < new
        return [each for drive in drives for each in asked(drive, new)]
    if which == "baudrate":
        assert found.baudrate is not None
        baudrate, these = found.baudrate
        assert list(these) == drives
        faster = [type(each)(each.address, baudrate=baudrate) for each in drives]
        return [each for drive in faster for each in asked(drive, every)]
    assert found.registers is not None
    kept = [reading.name for reading in drives[0].readings()[: found.registers]]
    return [each for drive in drives for each in asked(drive, every, *kept)]


@pytest.mark.parametrize("which", ["every", "baudrate", "registers"])
def test_each_suggestion_makes_the_line_reach_its_rates(which: str) -> None:
    drives: list[Drive] = [Simple(address, name=f"drive-{address}") for address in range(1, 5)]
    exchanges = [each for drive in drives for each in asked(drive, 0.15)]
    prediction = predict(exchanges)
    assert not prediction.fits
    found = suggest(exchanges, prediction)
    assert predict(with_suggestion(drives, found, 0.15, which)).fits


def test_a_suggestion_is_no_larger_than_needed() -> None:
    drive = Simple(1)
    exchanges = asked(drive, 0.045)  # two exchanges take 51 ms
    found = suggest(exchanges, predict(exchanges))
    assert found.every[0][1] <= 0.056
    assert found.baudrate is not None
    assert found.baudrate[0] == 19200
    assert found.registers == 2  # one request


def test_a_change_that_does_not_help_is_not_suggested() -> None:
    drive = YD1000(1)
    exchanges = asked(drive, 0.001, "output_frequency")
    found = suggest(exchanges, predict(exchanges))
    assert found.baudrate is None
    assert found.registers is None
    assert "baudrate" not in str(found)
    assert "every" in str(found)


def test_duration_text_returns_a_plant_files_notation() -> None:
    assert [duration_text(each) for each in (0.05, 0.0025, 1.0, 60.0)] == ["50 ms", "2.5 ms", "1 s", "60 s"]


def test_a_prediction_depends_on_the_framing() -> None:
    rtu, text = InnovertIBD(1), InnovertIBD(1, framing=Framing.ASCII)
    ascii_own = (17 + 15 + 1.5) * 10 * BIT + text.response_delay + BIT  # ":0103....LRC\r\n"
    assert predict(asked(text, None, "output_current")).cycle == pytest.approx(ascii_own)
    assert predict(asked(rtu, None, "output_current")).cycle > 10e-3


def test_suggestions_as_text_are_one_sentence() -> None:
    every = 'every = "100 ms" instead of 50 ms'
    found = Suggestions(((0.05, 0.1),), (19200, (YD1000(1, name="fan-1"), YD1000(2, name="fan-2"))), 3)
    assert str(found) == (
        f"it would fit with {every}, or baudrate = 19200 for fan-1, fan-2, "
        "or at most 3 of these registers for each drive"
    )
