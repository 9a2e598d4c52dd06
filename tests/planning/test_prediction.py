"""Predictions of a line's performance, compared with frame lengths counted manually, and with the C core."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_driver import LineDriver
from own_drives import ADDRESSES, Meter, StatedMeter
from tables import examples

from multidrop.cli import main
from multidrop.core import Peer, build_reply
from multidrop.drive import Drive, Framing
from multidrop.drive.register import HOLDING, INPUT, reading
from multidrop.families import MODELS, YD1000, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.families.files.loader import load_family
from multidrop.families.registry import SHIPPED
from multidrop.planning import prediction
from multidrop.planning.blocks import Planned, planned
from multidrop.planning.bus_time import in_order
from multidrop.planning.prediction import LATENESS, Suggestions, duration_text, reading_gain, suggest
from multidrop.planning.prediction import predict as predict_with_host
from multidrop.planning.schedule import TURN_SHARE
from multidrop.sim import EncodedDrive
from multidrop.transport.drive_reads import make_exchange

BIT = 1 / 9600
predict = partial(predict_with_host, lateness=0.0)


class Simple(Drive):
    """A family with four registers that need two requests."""

    title = "SIMPLE"
    baudrates = (9600, 19200, 38400)
    most_registers = {HOLDING: 2}
    response_delay = 4e-3
    a = reading(1)
    b = reading(2)
    c = reading(11)
    d = reading(12)


# duration of one exchange in s: request and reply of two registers in 8N1, and the response delay
OWN = (8 + 9) * 10 * BIT + 4e-3
SILENCE = 3.5 * 10 * BIT + BIT


def asked(drive: Drive, every: float | None = None, *names: str) -> list[Planned]:
    registers = [drive.register(name) for name in names] or drive.readings()
    return planned(drive, [(register, every) for register in registers])


def test_the_predicted_bus_cycle_includes_characters_response_delays_and_silences() -> None:
    drives = [Simple(1, name="one", format="8N1"), Simple(2, name="two", format="8N1")]
    found = predict([each for drive in drives for each in asked(drive)])
    assert found.cycle == pytest.approx(4 * (OWN + SILENCE))
    assert found.utilisation == 1
    assert [(rate.requests, len(rate.registers)) for rate in found.rates] == [(2, 4), (2, 4)]
    assert [rate.reached for rate in found.rates] == pytest.approx([1 / found.cycle] * 2)
    assert found.exchanges_per_second(drives[0]) == pytest.approx(2 / found.cycle)


def test_the_prediction_simulates_equal_lines_only_once(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_the_prediction_includes_a_shorter_silence_declared_for_a_drive() -> None:
    usual, short = ErmanERG220(1), ErmanERG220(1, silence=500e-6)
    cycles = [predict(asked(each, None, "output_current")).cycle for each in (usual, short)]
    assert cycles[0] - cycles[1] == pytest.approx(1.25e-3)


def test_the_prediction_includes_10_ms_of_silence_before_and_after_an_innovert_ibd() -> None:
    """In a cycle of three drives, two of the three silences are those of the INNOVERT IBD."""
    che, other, ibd = InvtCHE(1, format="8N1"), InvtCHE(2, format="8N1"), InnovertIBD(3)
    exchanges = [asked(one, None, "output_current") for one in (che, other, ibd)]
    found = predict([one for each in exchanges for one in each])
    own = 3 * (8 + 7) * 10 * BIT + 2 * che.response_delay + ibd.response_delay
    assert found.cycle == pytest.approx(own + 2 * (10e-3 + BIT) + SILENCE)


def test_the_prediction_includes_the_time_of_each_change_of_line_settings() -> None:
    drives = [ErmanERG220(1), YD1000(2), ErmanERG220(3)]
    exchanges = [each for drive in drives for each in asked(drive, None, "output_frequency")]
    free, dear = predict(exchanges), predict(exchanges, switching=0.01)
    assert dear.cycle - free.cycle == pytest.approx(2 * 0.01)
    assert (free.switches, predict(asked(ErmanERG220(1))).switches) == (2, 0)


def test_the_prediction_for_a_network_port_includes_no_change_of_line_settings() -> None:
    drives = [InvtCHE(1, baudrate=9600), InvtCHE(2, baudrate=19200)]
    for drive in drives:
        drive.take_framing_of("tcp://10.0.0.7")
    exchanges = [each for drive in drives for each in asked(drive, None, "output_frequency")]
    assert predict(exchanges).switches == 0
    assert predict(exchanges, switching=0.01).cycle == predict(exchanges).cycle


def test_suggested_settings_include_the_time_of_changing_line_settings() -> None:
    drives = [ErmanERG220(1), YD1000(2)]
    exchanges = [each for drive in drives for each in asked(drive, 0.06, "output_frequency")]
    periods = []
    for switching in (0.0, 0.05):
        found = suggest(exchanges, predict(exchanges, switching=switching), switching)
        periods.append(found.every[0][1])
        changed = [each for drive in drives for each in asked(drive, periods[-1], "output_frequency")]
        assert predict(changed, switching=switching).fits
    assert periods[1] > periods[0]


def test_the_prediction_uses_measured_instead_of_documented_response_delays() -> None:
    one, two = Simple(1), Simple(2)
    exchanges = [*asked(one), *asked(two)]
    assert predict(exchanges, {one: 9e-3}).cycle == pytest.approx(predict(exchanges).cycle + 2 * 5e-3)


def test_registers_without_a_period_use_the_remaining_line_time() -> None:
    timed, eager = Simple(1, format="8N1"), Simple(2, format="8N1")
    found = predict([*asked(timed, 0.1), *asked(eager)])
    load = 2 * (OWN + SILENCE) / 0.1
    assert [rate.reached for rate in found.rates] == pytest.approx([10, (1 - load) / (2 * (OWN + SILENCE))])
    assert found.fits
    assert predict(asked(timed, 0.1)).utilisation == pytest.approx(load)


def test_the_predicted_rate_never_exceeds_the_capacity_of_the_line() -> None:
    drives = [Simple(address, format="8N1") for address in range(1, 5)]
    found = predict([each for drive in drives for each in asked(drive, 0.05)])
    assert found.utilisation == pytest.approx(8 * (OWN + SILENCE) / 0.05)
    assert not found.fits
    assert [rate.reached for rate in found.rates] == pytest.approx([1 / found.cycle] * 4, rel=0.01)


def test_a_drive_without_a_period_is_polled_on_an_overloaded_line() -> None:
    hasty, eager = Simple(1, name="hasty", format="8N1"), Simple(2, name="eager", format="8N1")
    found = predict([*asked(hasty, 0.02), *asked(eager)])
    assert [(rate.drive.name, rate.fits) for rate in found.rates] == [("hasty", False), ("eager", True)]
    assert found.rates[1].reached == pytest.approx(TURN_SHARE / (2 * (OWN + SILENCE)))
    assert found.rates[0].reached == pytest.approx((1 - TURN_SHARE) / (2 * (OWN + SILENCE)), rel=0.01)


def test_the_prediction_adds_the_delay_of_the_computer_to_each_exchange() -> None:
    exchanges = [*asked(Simple(1)), *asked(Simple(2))]
    assert predict_with_host(exchanges).cycle == pytest.approx(predict(exchanges).cycle + 4 * LATENESS)


def carried_out(exchanges: Sequence[Planned]) -> float:
    """Return the seconds of a bus cycle in the C core if every drive has its documented response delay."""
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
def test_the_bus_cycle_of_the_c_core_takes_the_predicted_time(wanted: list[tuple[str, int, int]]) -> None:
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
def test_the_exchanges_predicted_for_a_second_fit_into_a_second(
    wanted: list[tuple[str, float | None]],
) -> None:
    """The exchanges that are predicted for one second fit into one second."""
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
def test_each_suggested_change_makes_the_line_reach_its_polling_rates(which: str) -> None:
    drives: list[Drive] = [Simple(address, name=f"drive-{address}") for address in range(1, 5)]
    exchanges = [each for drive in drives for each in asked(drive, 0.15)]
    prediction = predict(exchanges)
    assert not prediction.fits
    found = suggest(exchanges, prediction)
    assert predict(with_suggestion(drives, found, 0.15, which)).fits


def test_a_suggested_change_is_no_larger_than_needed() -> None:
    drive = Simple(1)
    exchanges = asked(drive, 0.045)  # the two exchanges take 51 ms
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


def test_a_duration_is_shown_in_the_notation_of_plant_files() -> None:
    assert [duration_text(each) for each in (0.05, 0.0025, 1.0, 60.0)] == ["50 ms", "2.5 ms", "1 s", "60 s"]


def test_prediction_depends_on_the_framing() -> None:
    rtu, text = InnovertIBD(1), InnovertIBD(1, framing=Framing.ASCII)
    ascii_own = (17 + 15 + 1.5) * 10 * BIT + text.response_delay + BIT  # ":0103....LRC\r\n"
    assert predict(asked(text, None, "output_current")).cycle == pytest.approx(ascii_own)
    assert predict(asked(rtu, None, "output_current")).cycle > 10e-3


def test_the_text_of_suggested_changes_is_one_sentence() -> None:
    every = 'every = "100 ms" instead of 50 ms'
    found = Suggestions(((0.05, 0.1),), (19200, (YD1000(1, name="fan-1"), YD1000(2, name="fan-2"))), 3)
    assert str(found) == (
        f"it would fit with {every}, or baudrate = 19200 for fan-1, fan-2, "
        "or at most 3 of these registers for each drive"
    )


SUPPORT = Path(__file__).parents[1] / "support" / "drives"
PLANT = f"""
[[line]]
name = "hall"
port = "/dev/ttyUSB0"

[[line.drive]]
name = "meter-1"
model = '{SUPPORT / "own_drives.py"}:Meter'
address = 1
baudrate = 9600
format = "8N1"

[[line.drive]]
name = "pump-1"
model = "innovert-ibd"
address = 2
baudrate = 9600
format = "8N1"
"""
SENTENCE = (
    "4 requests with readable_gaps = {INPUT: range(0x36, 0x46)} instead of 8: 0.268 s instead of 0.341 s; "
    "declare these gaps if the manual allows reads there"
)


def test_reads_across_address_gaps_save_a_fifth_of_the_time() -> None:
    drive = Meter(1, baudrate=9600, format="8N1")
    gain = reading_gain(drive, [(drive.register(name), None) for name in ADDRESSES])
    assert gain is not None
    assert str(gain) == SENTENCE
    assert drive.readable_gaps == Meter.readable_gaps == {}
    stated = type("Told", (Meter,), {"__doc__": "As advised.", "readable_gaps": dict(gain.gaps)})
    told = stated(1, baudrate=9600, format="8N1")
    assert reading_gain(told, [(told.register(name), None) for name in ADDRESSES]) is None


def test_a_suggestion_for_a_family_file_is_written_in_toml(tmp_path: Path) -> None:
    source = (
        "[family]\ntitle = 'Meter'\nmanual = 'of this test'\ncounts_from = 0\n[reading]\n"
        "low = { at = 1, unit = 'V' }\nhigh = { at = 3, unit = 'V' }\n"
    )
    path = tmp_path / "meter.toml"
    path.write_text(source, "utf-8")
    gains = []
    for line in ("counts_from = 0", "counts_from = 0\ngaps = { holding = [0x2, 0x2] }"):
        path.write_text(source.replace("counts_from = 0", line), "utf-8")
        drive = load_family(path)(1)
        gains.append(reading_gain(drive, [(register, None) for register in drive.readings()]))
    assert str(gains[0]).startswith("1 request with gaps = { holding = [0x2, 0x2] } instead of 2: ")
    assert gains[1] is None


def test_reads_across_address_gaps_are_suggested_only_if_useful() -> None:
    class Compact(Drive):
        a = reading(1)
        b = reading(2)
        far = reading(2000)

    for drive in (StatedMeter(1), Compact(1)):
        assert reading_gain(drive, [(register, None) for register in drive.readings()]) is None


def test_suggested_reads_do_not_exceed_the_read_limit_of_the_class() -> None:
    class Limited(Drive):
        most_registers = {HOLDING: 3}
        a = reading(1)
        b = reading(3)
        c = reading(5)

    gain = reading_gain(Limited(1), [(register, None) for register in Limited.registers.values()])
    assert gain is not None
    assert (gain.requests, gain.requests_now) == (2, 3)
    assert [len(gap) for _, gap in gain.gaps] == [1]


def test_reads_across_address_gaps_are_suggested_only_for_user_classes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant = tmp_path / "hall.toml"
    plant.write_text(PLANT, "utf-8")
    main(["plan", str(plant), "--json"])
    warnings = json.loads(capsys.readouterr().out)["lines"]["hall"]["warnings"]
    assert len(warnings) == 1
    assert warnings[0].startswith(
        "meter-1: 5 requests with readable_gaps = {INPUT: range(0x36, 0x46)} instead of 9"
    )
    main(["models", f"{SUPPORT / 'own_drives.py'}:Meter"])
    told = " ".join(capsys.readouterr().out.split())
    assert "reading all readings in 5 requests with readable_gaps" in told
    assert "read 04H, at most 125, the standard's limit: the family states none" in told
    for model in (*MODELS, *SHIPPED):
        main(["models", model])
        told = " ".join(capsys.readouterr().out.split())
        assert "readable_gaps" not in told
        # only shipped family files may leave out the read limit, because some manuals do not state it
        assert "the family states none" not in told or model in SHIPPED


def test_the_commands_plan_and_models_show_read_groups_and_intervals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = (
        "from multidrop import Drive, reading\n"
        "class Own(Drive):\n"
        "    least_interval = 0.1\n"
        "    read_together = (('high', 'low'),)\n"
        "    high = reading(1)\n"
        "    low = reading(2)\n"
    )
    (tmp_path / "own.py").write_text(source, "utf-8")
    main(["models", f"{tmp_path / 'own.py'}:Own"])
    told = capsys.readouterr().out
    assert "interval        100 ms from the end of an exchange to the next request" in told
    assert "read together   high, low" in told
    main(["models", f"{tmp_path / 'own.py'}:Own", "--json"])
    facts = json.loads(capsys.readouterr().out)
    assert (facts["least_interval_s"], facts["read_together"]) == (0.1, [["high", "low"]])
    assert facts["read_limits"] == {"holding register": 125}
    assert INPUT.name not in facts["read_limits"]
