"""Notifications about alarms: each start and end of an alarm is sent once, even if targets fail or hang."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from forwarded import Posted, web_server
from gateways import served
from lines import PATIENCE, until
from tables import table

from multidrop import Plant
from multidrop.gateway import sending
from multidrop.gateway.live.alarms import FAULT, PORT, Alarm, AlarmChange, Alarms
from multidrop.gateway.live.hub import RUNS, Shown
from multidrop.gateway.notifications import (
    MOST_TARGETS,
    MOST_WAITING,
    AlarmQueue,
    AlarmTarget,
    Notifications,
    NotifySettings,
    Sender,
    message_of,
    read_targets,
    sender_to,
)
from multidrop.gateway.parts import build

BEGUN = Alarm(1_000, "pump", "overcurrent", None, FAULT)


def over(alarm: Alarm, ended: int = 2_000) -> Alarm:
    return alarm._replace(ended=ended)


def flaps(number: int) -> list[Alarm]:
    """Return the alarms that a drive reports when a fault comes and goes this many times."""
    return [
        one for at in range(number) for one in (BEGUN._replace(time=at), over(BEGUN._replace(time=at), at))
    ]


def note(part: Notifications, alarm: Alarm) -> None:
    """Report the start or the end of an alarm to the notifications."""
    part.note_alarm(alarm, AlarmChange.BEGAN if alarm.ended is None else AlarmChange.ENDED)


def described(alarm: Alarm, left_out: int) -> dict[str, Any]:
    return message_of("plant", "http://page/", alarm, left_out)


class Clocked:
    """A sender of notifications with a simulated clock. It records messages; `failure` makes it fail."""

    def __init__(self, most: int = 3600) -> None:
        self.now_s = 0.0
        self.failure: Exception | None = None
        self.messages: list[dict[str, Any]] = []
        self.sender = Sender("target", self._send, AlarmQueue(most, 0.0), described, lambda: self.now_s)

    def _send(self, message: dict[str, Any]) -> None:
        if self.failure:
            raise self.failure
        self.messages.append(message)

    def send_all(self) -> float:
        """Send all messages that the limits allow now; return the seconds until the next attempt."""
        while (pause_s := self.sender.step()) == 0:
            pass
        return pause_s


def test_one_message_is_sent_for_each_start_and_end_of_an_alarm() -> None:
    target, alarms = Clocked(), flaps(1000)
    part = Notifications([target.sender], [FAULT])
    for alarm in alarms:
        note(part, alarm)
        target.now_s += 2  # slowly enough for the limit of 3600 messages an hour
        target.send_all()
    assert [(one["event"], one["id"]) for one in target.messages] == [
        ("begin" if alarm.ended is None else "end", alarm.id) for alarm in alarms
    ]


def test_only_the_start_and_the_end_of_an_alarm_are_sent() -> None:
    target = Clocked()
    alarms = Alarms(note=Notifications([target.sender], [PORT]).note_alarm)
    alarms.look(1_000, "pump", Shown(FAULT, "overcurrent"))
    alarms.look_at_line(1_000, "hall", "the port is lost")
    alarms.look_at_line(1_100, "hall", "there is no such port")
    [alarm] = [one for one in alarms.lasting if one.kind == PORT]
    alarms.acknowledge(alarm.id, 1_200, "anna")
    alarms.look_at_line(1_300, "hall", None)
    alarms.acknowledge(alarm.id, 1_400, "anna")
    target.send_all()
    assert [(one["event"], one["line"]) for one in target.messages] == [("begin", "hall"), ("end", "hall")]


def test_a_restart_does_not_repeat_notifications() -> None:
    target = Clocked()
    alarms = Alarms(note=Notifications([target.sender], [FAULT, PORT]).note_alarm)
    lost = Alarm(1_000, "", "the port is lost", None, PORT, "hall")
    alarms.restore([BEGUN, lost], 1_500, ["pump", "hall"])
    alarms.look(1_600, "pump", Shown(FAULT, BEGUN.text))
    alarms.look_at_line(1_600, "hall", "there is no such port")
    assert target.send_all() == inf
    alarms.look(2_000, "pump", Shown(RUNS, ""))
    target.send_all()
    assert [one["event"] for one in target.messages] == ["end"]


def test_the_newest_notification_is_sent_when_the_hourly_limit_allows_it() -> None:
    target = Clocked(most=60)
    for alarm in (*flaps(100), BEGUN._replace(time=100)):
        target.sender.put(alarm)
    assert target.send_all() == pytest.approx(60.0)
    assert len(target.messages) == 60
    target.now_s += 61
    target.send_all()
    [newest] = target.messages[60:]
    assert (newest["event"], newest["time"]) == ("begin", "1970-01-01T00:00:00.100Z")
    assert newest["text"] == "pump: fault: overcurrent (140 earlier messages were left out)"


def test_number_of_waiting_notifications_is_limited() -> None:
    queue = AlarmQueue(60, 0.0)
    for number in range(MOST_WAITING + 100):
        queue.put(BEGUN._replace(drive=f"pump-{number}"))
    assert (len(queue), queue.left_out) == (MOST_WAITING, 100)


def test_a_failed_message_is_sent_again_after_growing_pauses() -> None:
    target = Clocked()
    target.sender.put(BEGUN)
    target.failure = OSError("500")
    pauses = [target.send_all() for _ in range(8)]
    assert (pauses[:3], pauses[-1]) == ([5, 10, 20], Sender.most_pause_s)
    assert target.sender.problem == "target takes no messages: 500"
    target.failure = None
    assert target.send_all() == inf
    assert (len(target.messages), target.sender.problem) == (1, "")


def test_later_notifications_are_sent_after_one_is_refused_for_good() -> None:
    target = Clocked()
    target.sender.put(BEGUN)
    target.failure = ValueError("no JSON")
    target.send_all()
    target.sender.put(over(BEGUN))
    target.failure = None
    target.send_all()
    assert [one["text"] for one in target.messages] == [
        "pump: fault is over: overcurrent (1 earlier messages were left out)"
    ]


def test_a_notification_is_sent_if_queued_just_before_the_shutdown() -> None:
    target = Clocked()
    thread = threading.Thread(target=target.sender.run)
    thread.start()
    target.sender.put(BEGUN)
    target.sender.close()
    thread.join()
    assert len(target.messages) == 1


def test_a_hanging_notification_target_does_not_delay_other_targets() -> None:
    hang, other = threading.Event(), Clocked()
    hanging = Sender("hanging", lambda message: hang.wait() and None, AlarmQueue(60, 0.0), described)
    threads = [threading.Thread(target=one.run, daemon=True) for one in (hanging, other.sender)]
    for thread in threads:
        thread.start()
    part = Notifications([hanging, other.sender], [FAULT])
    for alarm in flaps(500):
        note(part, alarm)
    until(lambda: len(other.messages) == 1000)
    assert hanging.sent == 0
    hang.set()
    for sender in (hanging, other.sender):
        sender.close()
    for thread in threads:
        thread.join()


@pytest.fixture
def webhook() -> Iterator[Posted]:
    with web_server() as posted:
        yield posted


@pytest.mark.parametrize("status", [302, 404, 500])
def test_a_webhook_gets_json_and_an_error_status_raises(webhook: Posted, status: int) -> None:
    send = sender_to(AlarmTarget("target", webhook.url))
    send(described(BEGUN, 0))
    webhook.status = status
    with pytest.raises(OSError, match=str(status)):
        send(described(over(BEGUN), 0))
    assert webhook.batches == [
        {
            "event": "begin",
            "title": "plant: pump",
            "text": "pump: fault: overcurrent",
            "plant": "plant",
            "line": "",
            "drive": "pump",
            "kind": "fault",
            "alarm": "overcurrent",
            "id": "1000 fault pump",
            "time": "1970-01-01T00:00:01.000Z",
            "ended": None,
            "page": "http://page/",
        }
    ]


def test_a_refused_connection_of_a_webhook_is_reported_in_one_sentence() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # nothing listens on this port
        send = sender_to(AlarmTarget("target", f"http://127.0.0.1:{unused.getsockname()[1]}/"))
        with pytest.raises(OSError, match=r"^Connection refused$"):
            send(described(BEGUN, 0))


def test_a_webhook_answer_in_another_protocol_is_reported_in_one_sentence() -> None:
    def answer() -> None:
        peer, _ = listener.accept()
        with peer:
            peer.recv(1 << 16)
            peer.sendall(b"SSH-2.0-OpenSSH_9.6\r\n")

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(OSError, match=r"^the server's answer is not HTTP$"):
            sending.post(f"http://127.0.0.1:{listener.getsockname()[1]}/", b"", {})
        thread.join()


def test_a_webhook_times_out_if_its_answer_arrives_byte_by_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sending, "SEND_S", 0.1)
    ends = time.monotonic() + PATIENCE

    def trickle() -> None:
        peer, _ = listener.accept()
        with peer, suppress(OSError):  # raised when the client closes the connection
            while time.monotonic() < ends:
                peer.sendall(b"H")
                time.sleep(0.01)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=trickle)
        thread.start()
        with pytest.raises(OSError, match=r"did not end within 0.1 s|timed out"):
            sending.post(f"http://127.0.0.1:{listener.getsockname()[1]}/", b"", {})
        thread.join()


@table(
    ("line", "sentence"),
    [
        ("hooks.example/T0K3N", "is not a URL"),
        ("https://", "is not a URL"),
        ("https:///T0K3N", "the webhook is not of the form"),
        ("https://[T0K3N/x", "the webhook is not of the form"),
        ("https://anna:T0K3N@hooks.example/", "the webhook is not of the form"),
        ("", "has no target"),
        ("# https://hooks.example/T0K3N", "has no target"),
    ],
)
def test_the_error_about_an_invalid_notification_target_shows_no_secret(
    tmp_path: Path, line: str, sentence: str
) -> None:
    (tmp_path / "targets").write_text(f"{line}\n")
    found, [mistake] = read_targets(tmp_path / "targets")
    assert (found, sentence in mistake, "T0K3N" in mistake) == ([], True, False)


def test_mistakes_in_the_settings_for_notifications_are_reported(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="most = 0 is not 1 to") as wrong:
        NotifySettings(on=("fire",), most=0)
    assert "on: 'fire' is not a kind of alarm" in str(wrong.value)
    plant = Plant((), tmp_path / "plant.toml")
    [mistake] = NotifySettings().check(plant)
    assert mistake.endswith("targets cannot be read: No such file or directory")
    (tmp_path / "targets").write_text("https://hooks.example/\n" * (MOST_TARGETS + 1))
    [mistake] = NotifySettings().check(plant)
    assert f"has {MOST_TARGETS + 1} targets, but {MOST_TARGETS} at most are allowed" in mistake


def test_the_shown_name_of_a_notification_target_contains_no_secret(tmp_path: Path) -> None:
    (tmp_path / "targets").write_text("https://hooks.example/T0K3N?key=T0K3N\ntgram://T0K3N/1\n")
    found, _ = read_targets(tmp_path / "targets")
    assert [one.name for one in found] == [
        "target https://hooks.example in line 1 of targets",
        "target tgram:// in line 2 of targets",
    ]


def test_a_missing_apprise_library_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "apprise", None)
    (tmp_path / "targets").write_text("ntfy://alarms\n")
    context: Any = SimpleNamespace(plant=SimpleNamespace(path=tmp_path / "plant.toml"), page="")
    settings = SimpleNamespace(targets="targets", most=60, on=[FAULT])
    with pytest.raises(ValueError, match=r"the library apprise is not installed: pip install .*notify"):
        build("notify", settings, context)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*imghdr:DeprecationWarning")  # Apprise imports the deprecated imghdr
def test_apprise_sends_the_title_and_the_text(webhook: Posted) -> None:
    pytest.importorskip("apprise")
    with pytest.raises(ValueError, match="target is not an address that Apprise knows"):
        sender_to(AlarmTarget("target", "nosuch://x"))
    send = sender_to(AlarmTarget("target", webhook.url.replace("http://", "json://")))
    send(described(BEGUN, 0))
    [posted] = webhook.batches
    assert (posted["title"], posted["message"]) == ("plant: pump", "pump: fault: overcurrent")
    webhook.status = 500
    with pytest.raises(OSError, match="did not accept"):
        send(described(BEGUN, 0))


@pytest.mark.slow
def test_faults_and_exceeded_limits_are_sent_as_messages(tmp_path: Path, webhook: Posted) -> None:
    (tmp_path / "targets").write_text(webhook.url)
    limit = '[[serve.limit]]\ndrive = "pump-1"\nregister = "output_frequency"\nabove = 100.0\n'
    below = limit.replace("above = 100.0", "below = 1.0")
    with served(tmp_path, f"[serve.notify]\n{limit}{below}") as gateway:
        gateway.await_state("pump-1", "stands")
        gateway.sims["pump-1"].trip(4)  # type: ignore[attr-defined]
        until(lambda: len(webhook.batches) == 2)
        until(lambda: "\nmultidrop_notifications_sent_total 2.0\n" in gateway.get("/metrics").body.decode())
        webhook.status = 500
        gateway.sims["pump-1"].motor.reset()  # type: ignore[attr-defined]
        until(lambda: "500" in gateway.get("/health").json["parts"].get("notify", ""))
        assert "secret-path" not in gateway.get("/health").body.decode()
    found = {(one["drive"], one["kind"]): one["alarm"] for one in webhook.batches}
    assert found.keys() == {("pump-1", "limit"), ("pump-1", "fault")}
    assert found["pump-1", "limit"] == "output_frequency below 1 Hz"
    # The status may be read before the register that has the number of the fault.
    assert found["pump-1", "fault"] in ("overcurrent while accelerating (OC1)", "it shows a fault")


def test_the_next_notification_counts_the_messages_left_out() -> None:
    target = Clocked()
    send = target.sender._send

    def send_slowly(message: dict[str, Any]) -> None:
        if not target.messages:
            for number in range(MOST_WAITING + 100):
                target.sender.put(BEGUN._replace(drive=f"pump-{number}"))
        send(message)

    target.sender._send = send_slowly
    target.sender.put(BEGUN)
    target.send_all()
    assert target.messages[1]["text"].endswith("(100 earlier messages were left out)")
