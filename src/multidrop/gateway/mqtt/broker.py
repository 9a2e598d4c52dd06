"""A connection to an MQTT broker, re-established after each loss."""

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

# limit of messages that the broker has not acknowledged: enough for the drives of two lines
MOST_UNDER_WAY = 64
# limit of messages that wait to be sent, at most one per topic; no plant needs more topics
MOST_WAITING = 4096
MOST_RECEIVED = 4  # limit of received messages that wait for the event loop
PORTS = {"mqtt": 1883, "mqtts": 8883}
RETRY_S = (1, 30)  # in s: the first and the longest pause before reconnecting
KEEP_ALIVE_S = 15
FAREWELL_S = 1.0  # time limit, in s, for sending the last messages before a disconnect
CONFIRM_S = 10.0  # time limit, in s, for the broker's confirmation of messages
CONFIRMED = "multidrop/confirmed"  # topic without a subscription; see `confirm`
_log = logging.getLogger("multidrop.gateway.mqtt.part")


class Publication(NamedTuple):
    """The topic of a message, and a function that makes its payload when the message is sent."""

    topic: str
    make: Callable[[], bytes]
    qos: int = 1
    is_retained: bool = False


class Outbox:
    """Messages that wait to be sent, at most one per topic, and the messages that await acknowledgement.

    At most MOST_UNDER_WAY messages await acknowledgement. `send` takes a message and returns its number, or
    None if it cannot be sent now.
    """

    def __init__(self, send: Callable[[Publication], int | None]) -> None:
        self._send = send
        self._waiting: dict[str, Publication] = {}
        self._under_way: set[int] = set()
        self.sent = 0
        self.dropped = 0  # number of messages that were replaced by a newer one, or lost with the connection

    def put(self, message: Publication) -> None:
        """Queue a message. It replaces a waiting message on the same topic."""
        if message.topic in self._waiting or len(self._waiting) >= MOST_WAITING:
            self.dropped += 1
        if message.topic in self._waiting or len(self._waiting) < MOST_WAITING:
            self._waiting[message.topic] = message
        self.flush()

    def withdraw(self, topic: str) -> None:
        """Drop the message that waits to be sent on a topic, if any."""
        self.dropped += self._waiting.pop(topic, None) is not None

    def flush(self) -> None:
        """Send waiting messages, while fewer than MOST_UNDER_WAY await acknowledgement."""
        while self._waiting and len(self._under_way) < MOST_UNDER_WAY:
            topic = next(iter(self._waiting))
            try:
                number = self._send(self._waiting[topic])
            except Exception as failure:  # the message itself cannot be sent: drop it, and send the others
                del self._waiting[topic]
                self.dropped += 1
                _log.warning("the message on %.100r cannot be sent: %r", topic, failure)
                continue
            if number is None:
                return
            del self._waiting[topic]
            self._under_way.add(number)
            self.sent += 1

    def acknowledge(self, numbers: Iterable[int]) -> None:
        """Note that the broker has acknowledged the messages with these numbers."""
        self._under_way.difference_update(numbers)
        self.flush()

    def forget(self) -> None:
        """Drop all messages. Called when the connection is lost."""
        self.dropped += len(self._waiting) + len(self._under_way)
        self._waiting.clear()
        self._under_way.clear()

    @property
    def is_idle(self) -> bool:
        return not self._waiting and not self._under_way


class Address(NamedTuple):
    """The address of a broker."""

    host: str
    port: int
    is_tls: bool


def parse_broker(text: str) -> Address:
    """Return the address in a URL of the form `mqtt://host:port`.

    Raises ValueError for other texts, with passwords masked.
    """
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    if "@" in text:
        raise ValueError(
            f'broker = "{masked(text)}" contains a user or password; write user = "name" and '
            'password = "FILE" instead'
        )
    is_plain = not (parts.path.strip("/") or parts.query or parts.fragment or parts.username)
    if parts.scheme not in PORTS or not parts.hostname or not is_plain:
        raise ValueError(
            f'broker = "{text}" is not a broker\'s URL; write one such as "mqtt://broker:1883", or '
            "mqtts:// for TLS"
        )
    return Address(parts.hostname, port or PORTS[parts.scheme], parts.scheme == "mqtts")


class Login(NamedTuple):
    """User name and password for the broker, and certificates that verify the broker."""

    user: str = ""
    password: str = ""
    # path of a file with trusted certificates; None: those of the operating system
    authorities: str | None = None


def make_client(address: Address, login: Login, name: str) -> Any:
    """Return an MQTT client of the library paho with this login. It is not connected yet."""
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    client: Any = Client(CallbackAPIVersion.VERSION2, client_id=name, clean_session=True)
    if login.user:
        client.username_pw_set(login.user, login.password or None)
    if address.is_tls:
        client.tls_set_context(ssl.create_default_context(cafile=login.authorities))
    return client


class Messages(Protocol):
    """The format of one connection's messages. It makes sent messages and handles received ones.

    JsonTopics and SparkplugNode implement it. The methods run in the event loop.
    """

    def will(self) -> Publication:
        """Return the message that the broker must publish when this connection breaks."""

    def topics(self) -> list[tuple[str, int]]:
        """Return the topics to subscribe to, with their QoS."""

    def connected(self) -> None:
        """Send the first messages of a new connection."""

    def received(self, topic: str, payload: bytes, *, is_retained: bool) -> None:
        """Handle a received message."""

    def publish(self) -> None:
        """Send values that are new since the previous call."""

    def leave(self) -> None:
        """Send the last messages before a disconnect."""


class Broker:
    """A connection to a broker, over which `Messages` are sent and received.

    A thread of the library paho sends them. Only `close` waits for that thread.
    """

    def __init__(self, address: Address, login: Login, name: str, messages: Messages) -> None:
        self._address = address
        self._name = name
        self._thread: threading.Thread | None = None  # paho's thread for this connection
        self._messages = messages
        self.loop: asyncio.AbstractEventLoop | None = None
        self.outbox = Outbox(self._send)
        self.is_connected = False
        self.failure = ""  # why publishing fails now; "" if it works
        self._connections = 0
        # futures of `confirm` that wait for the broker's answer, by packet number
        self._confirming: dict[int, asyncio.Future[None]] = {}
        self._client = make_client(address, login, name)
        self._client.reconnect_delay_set(*RETRY_S)
        # no limit in paho, because the outbox limits the messages in flight
        self._client.max_inflight_messages_set(0)
        self._client.on_connect = self._on_connect
        self._client.on_connect_fail = lambda *_: self._call(self._failed, "no answer")
        self._client.on_disconnect = lambda *given: self._call(self._lost, str(given[3]))
        self._client.on_publish = self._on_publish
        self._client.on_message = self._on_message
        self._client.on_unsubscribe = lambda *given: self._call(self._confirm, given[2])
        # numbers of acknowledged messages, appended in paho's thread and handled in the event loop
        self._arrived: deque[int] = deque()
        self._why = ""
        # one permit for each message that may wait for the event loop
        self._handled = threading.Semaphore(MOST_RECEIVED)

    def open(self) -> None:
        """Start to connect. paho retries after each failure."""
        self.loop = asyncio.get_running_loop()
        self._set_will()
        self._client.connect_async(self._address.host, self._address.port, KEEP_ALIVE_S)
        self._client.loop_start()
        self._thread = next((one for one in threading.enumerate() if one.name.endswith(self._name)), None)

    async def close(self) -> None:
        """Send waiting messages for at most FAREWELL_S seconds, then disconnect."""
        begun = asyncio.get_running_loop().time()
        while self.is_connected and not self.outbox.is_idle:
            if asyncio.get_running_loop().time() - begun > FAREWELL_S:
                break
            await asyncio.sleep(0.01)
        self.loop = None
        self._client.disconnect()
        with suppress(Hung):  # paho's daemon thread may hang in a DNS query
            await supervisor().within("mqtt", FAREWELL_S, self._client.loop_stop)
        self.is_connected = False
        self._client = None  # frees the sockets that paho uses to wake its thread

    def publish(self) -> None:
        """Publish new values.

        Without a connection, the outbox keeps the newest message of each topic. Raises RuntimeError if paho's
        thread has ended.
        """
        if self._thread is not None and not self._thread.is_alive():
            raise RuntimeError("the thread of the broker's connection has ended")
        had_failed = self.failure
        self._publish_by(self._messages.publish)
        if had_failed and not self.failure and self.is_connected:
            self.publish_all()

    def publish_all(self) -> None:
        """Publish all current messages again, as after a new connection."""
        self._publish_by(self._messages.connected)

    def _publish_by(self, publish: Callable[[], None]) -> None:
        """Call `publish`. If it fails, publish "offline", but keep receiving commands.

        Without "offline", the values that the broker retains would look current.
        """
        try:
            publish()
        except Exception as failure:
            if not self.failure:
                _log.exception("publishing fails")
                if self.is_connected:
                    self._messages.leave()
            self.failure = f"publishing fails: {type(failure).__name__}: {failure}"
        else:
            self.failure = ""

    async def confirm(self) -> None:
        """Wait until the broker has received all messages that are in the outbox now. Raises OSError.

        A message of QoS 0 is not acknowledged, but a broker handles packets in their order. So the
        broker's answer to a later packet confirms all messages before that packet. The later packet used
        here unsubscribes from CONFIRMED, which has no other effect.
        """
        connection = self._connections
        async with asyncio.timeout(CONFIRM_S):
            while self.is_connected and not self.outbox.is_idle:
                await asyncio.sleep(0.01)
            if not self.is_connected or connection != self._connections:
                raise ConnectionError(self.trouble)
            _, number = self._client.unsubscribe(CONFIRMED)
            self._confirming[number] = confirmed = asyncio.get_running_loop().create_future()
            await confirmed

    def _confirm(self, number: int) -> None:
        confirmed = self._confirming.pop(number, None)
        if confirmed is not None and not confirmed.done():
            confirmed.set_result(None)

    @property
    def trouble(self) -> str:
        """A sentence about the missing connection, with the reason if it is known."""
        return f"no connection to {self._address.host}:{self._address.port}" + (
            self._why and f": {self._why}"
        )

    def _send(self, message: Publication) -> int | None:
        if not self.is_connected:
            return None
        sent = self._client.publish(message.topic, message.make(), message.qos, message.is_retained)
        return int(sent.mid) if sent.rc == 0 else None

    def _set_will(self) -> None:
        will = self._messages.will()
        self._client.will_set(will.topic, will.make(), will.qos, will.is_retained)

    # ---- in the loop ----

    def _greet(self) -> None:
        self.is_connected = True
        self._connections += 1
        self._why = ""
        _log.info("connected to %s:%d", self._address.host, self._address.port)
        for topic, qos in self._messages.topics():
            self._client.subscribe(topic, qos)
        self.failure = ""  # a failure of the previous connection does not matter now
        self.outbox.forget()  # drop old messages: in Sparkplug, the first message must be a birth
        self.publish_all()

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
        for confirmed in self._confirming.values():
            if not confirmed.done():
                confirmed.set_exception(ConnectionError(why))
        self._confirming.clear()
        self._set_will()
        self._failed(why)

    # ---- in paho's thread ----

    def _call(self, what: Callable[..., None], *given: Any) -> None:
        loop = self.loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(what, *given)

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._call(self._failed, str(reason))
        else:
            self._call(self._greet)

    def _on_publish(self, _client: Any, _data: Any, number: int, *_more: Any) -> None:
        self._arrived.append(number)
        if len(self._arrived) == 1:  # if there are more, the event loop was woken for the first one already
            self._call(self._acknowledge)

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        received = self._messages.received

        def take() -> None:
            self._handled.release()
            received(message.topic, bytes(message.payload), is_retained=bool(message.retain))

        # the broker waits meanwhile, so a flood of messages delays no stop over another interface
        while self.loop is not None and not self._handled.acquire(timeout=0.1):
            pass
        self._call(take)
