"""Broker: one connection to an MQTT broker, made again for as long as it takes."""

from __future__ import annotations

import asyncio
import logging
import ssl
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, NamedTuple, Protocol
from urllib.parse import urlsplit

from multidrop.printable import masked
from multidrop.supervisor import Hung, supervisor

MOST_UNDER_WAY = 64  # messages that were sent, and not acknowledged: two lines' drives go at once
MOST_WAITING = 4096  # topics; more than any plant has

_log = logging.getLogger("multidrop.gateway.mqtt.part")


class Publication(NamedTuple):
    """A topic, and a function that makes its message when it is sent."""

    topic: str
    make: Callable[[], bytes]
    qos: int = 1
    is_retained: bool = False


class Outbox:
    """Messages that wait, one of each topic.

    `send` takes a message and returns its number, or None where it cannot be sent now.
    """

    def __init__(self, send: Callable[[Publication], int | None]) -> None:
        self._send = send
        self._waiting: dict[str, Publication] = {}
        self._under_way: set[int] = set()
        self.sent = 0
        self.dropped = 0  # replaced by a newer one, or lost with the connection

    def put(self, message: Publication) -> None:
        """Send the message as soon as there is room, in the place of an older one of its topic."""
        if message.topic in self._waiting or len(self._waiting) >= MOST_WAITING:
            self.dropped += 1
        if message.topic in self._waiting or len(self._waiting) < MOST_WAITING:
            self._waiting[message.topic] = message
        self.flush()

    def withdraw(self, topic: str) -> None:
        """Drop what waits of a topic, if anything does: something else was said since."""
        self.dropped += self._waiting.pop(topic, None) is not None

    def flush(self) -> None:
        """Send what waits, as far as there is room."""
        while self._waiting and len(self._under_way) < MOST_UNDER_WAY:
            topic = next(iter(self._waiting))
            try:
                number = self._send(self._waiting[topic])
            except Exception as failure:  # no broker takes this one; all others are sent
                del self._waiting[topic]
                self.dropped += 1
                _log.warning("what was to be said on %.100r cannot be sent: %r", topic, failure)
                continue
            if number is None:
                return
            del self._waiting[topic]
            self._under_way.add(number)
            self.sent += 1

    def acknowledge(self, numbers: Iterable[int]) -> None:
        """Note that messages have arrived."""
        self._under_way.difference_update(numbers)
        self.flush()

    def forget(self) -> None:
        """Drop all that waits: the connection is gone, and what comes next begins anew."""
        self.dropped += len(self._waiting) + len(self._under_way)
        self._waiting.clear()
        self._under_way.clear()

    @property
    def is_idle(self) -> bool:
        return not self._waiting and not self._under_way


PORTS = {"mqtt": 1883, "mqtts": 8883}
RETRY_S = (1, 30)  # before the first attempt to connect again, and at most
KEEP_ALIVE_S = 15
FAREWELL_S = 1.0  # that the last messages may take

_log = logging.getLogger("multidrop.gateway.mqtt.part")


class Address(NamedTuple):
    """A broker's address."""

    host: str
    port: int
    is_tls: bool


def parse_broker(text: str) -> Address:
    """Return the parts of `mqtt://host:port`. Raises ValueError for anything else, without its password."""
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if "@" in text:
        raise ValueError(
            f'broker = "{masked(text)}" comes with a login; write user = "name" and password = "FILE"'
        )
    is_plain = not (parts.path.strip("/") or parts.query or parts.fragment or parts.username)
    if parts.scheme not in PORTS or not parts.hostname or not is_plain:
        raise ValueError(f'broker = "{text}" is no broker; write broker = "mqtt://broker:1883", or mqtts://')
    return Address(parts.hostname, port or PORTS[parts.scheme], parts.scheme == "mqtts")


class Login(NamedTuple):
    """A user and his password, and the certificates by which the broker is known."""

    user: str = ""
    password: str = ""
    authorities: str | None = None  # a file; None: the system's


class Speaker(Protocol):
    """The user of a connection: it has messages to send, and takes those that come. Called in the loop."""

    def will(self) -> Publication:
        """Return the message that the broker sends when this connection breaks."""

    def topics(self) -> list[tuple[str, int]]:
        """Return the topics to listen to, with their QoS."""

    def connected(self) -> None:
        """Send what comes first on a new connection."""

    def received(self, topic: str, payload: bytes, *, is_retained: bool) -> None:
        """Take a message."""

    def publish(self) -> None:
        """Send what is new."""

    def pass_over(self) -> int:
        """Return how many messages would be sent now, had the broker a connection."""

    def leave(self) -> None:
        """Send that there will be nothing more to say."""


class Broker:
    """The connection of a speaker. Paho's thread does the sending; nothing here waits for it."""

    def __init__(self, address: Address, login: Login, name: str, speaker: Speaker) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        self._address = address
        self._name = name
        self._thread: threading.Thread | None = None  # paho's
        self._speaker = speaker
        self._loop: asyncio.AbstractEventLoop | None = None
        self.outbox = Outbox(self._send)
        self.is_connected = False
        self.failure = ""  # why the speaker cannot say anything now
        self._client: Any = Client(CallbackAPIVersion.VERSION2, client_id=name, clean_session=True)
        self._client.reconnect_delay_set(*RETRY_S)
        self._client.max_inflight_messages_set(0)  # the outbox has the bound
        if login.user:
            self._client.username_pw_set(login.user, login.password or None)
        if address.is_tls:
            self._client.tls_set_context(ssl.create_default_context(cafile=login.authorities))
        self._client.on_connect = self._on_connect
        self._client.on_connect_fail = lambda *_: self._call(self._failed, "it does not answer")
        self._client.on_disconnect = lambda *given: self._call(self._lost, str(given[3]))
        self._client.on_publish = self._on_publish
        self._client.on_message = self._on_message
        self._arrived: deque[int] = deque()  # numbers of messages that the loop does not know of yet
        self._why = ""

    def open(self) -> None:
        """Begin to connect; every failure is followed by another attempt."""
        self._loop = asyncio.get_running_loop()
        self._set_will()
        self._client.connect_async(self._address.host, self._address.port, KEEP_ALIVE_S)
        self._client.loop_start()
        self._thread = next((one for one in threading.enumerate() if one.name.endswith(self._name)), None)

    async def close(self) -> None:
        """Send what waits, for a second at most, and disconnect."""
        begun = asyncio.get_running_loop().time()
        while self.is_connected and not self.outbox.is_idle:
            if asyncio.get_running_loop().time() - begun > FAREWELL_S:
                break
            await asyncio.sleep(0.01)
        self._loop = None
        self._client.disconnect()
        with suppress(Hung):  # its thread may wait for a name server, and does not keep the process
            await supervisor().within("mqtt", FAREWELL_S, self._client.loop_stop)
        self.is_connected = False
        self._client = None  # with it go the sockets by which paho wakes its thread

    def publish(self) -> None:
        """Let the speaker say what is new, or count what it would have said.

        Raises RuntimeError if paho's thread has ended: nothing would be sent.
        """
        if self._thread is not None and not self._thread.is_alive():
            raise RuntimeError("the thread of its connection has ended")
        had_failed = self.failure
        self._let(self._speaker.publish if self.is_connected else self._pass_over)
        if had_failed and not self.failure and self.is_connected:
            self.begin_anew()

    def begin_anew(self) -> None:
        """Let the speaker say all, as on a new connection."""
        self._let(self._speaker.connected)

    def _pass_over(self) -> None:
        self.outbox.dropped += self._speaker.pass_over()

    def _let(self, say: Callable[[], None]) -> None:
        """Let the speaker say something; one that fails is away, and hears commands all the same.

        What the broker keeps of its drives would pass for the present otherwise.
        """
        try:
            say()
        except Exception as failure:
            if not self.failure:
                _log.exception("nothing can be said")
                if self.is_connected:
                    self._speaker.leave()
            self.failure = f"nothing can be said: {type(failure).__name__}: {failure}"
        else:
            self.failure = ""

    @property
    def trouble(self) -> str:
        """Return that there is no connection, and why where it is known."""
        return f"no connection to {self._address.host}:{self._address.port}" + (
            self._why and f": {self._why}"
        )

    def _send(self, message: Publication) -> int | None:
        if not self.is_connected:
            return None
        sent = self._client.publish(message.topic, message.make(), message.qos, message.is_retained)
        return int(sent.mid) if sent.rc == 0 else None

    def _set_will(self) -> None:
        will = self._speaker.will()
        self._client.will_set(will.topic, will.make(), will.qos, will.is_retained)

    # ---- in the loop ----

    def _greet(self) -> None:
        self.is_connected = True
        self._why = ""
        _log.info("connected to %s:%d", self._address.host, self._address.port)
        for topic, qos in self._speaker.topics():
            self._client.subscribe(topic, qos)
        self.failure = ""  # of the connection before; one of this one is to be told on it
        self.begin_anew()

    def _acknowledge(self) -> None:
        numbers = []
        while self._arrived:
            numbers.append(self._arrived.popleft())
        self.outbox.acknowledge(numbers)

    def _failed(self, why: str) -> None:
        if why != self._why:
            self._why = why
            _log.warning("%s", self.trouble)

    def _lost(self, why: str) -> None:
        self.is_connected = False
        self.outbox.forget()
        self._set_will()
        self._failed(why)

    # ---- in paho's thread ----

    def _call(self, what: Callable[..., None], *given: Any) -> None:
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(what, *given)

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._call(self._failed, str(reason))
        else:
            self._call(self._greet)

    def _on_publish(self, _client: Any, _data: Any, number: int, *_more: Any) -> None:
        self._arrived.append(number)
        if len(self._arrived) == 1:  # else the loop is woken already: they come many at a time
            self._call(self._acknowledge)

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        received = self._speaker.received

        def take() -> None:
            received(message.topic, bytes(message.payload), is_retained=bool(message.retain))

        self._call(take)
