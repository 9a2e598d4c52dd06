"""A broker that stands still holds commands up: what a stop overtook is not carried out after it."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest
from brokers import Listener, mosquitto
from gateways import served
from lines import until
from peers import require_module, require_program

from multidrop.gateway.http.rights import Right

SERVE = """[serve.may]
stop = "anyone"
write = ["pump-1.setpoint"]
verbs = ["pump-1.start"]
[serve.mqtt]
broker = "{}"
commands = true
"""


@pytest.mark.long
def test_a_start_that_a_broker_held_up_does_not_follow_a_stop(tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    with mosquitto(tmp_path) as broker, served(tmp_path, SERVE.format(broker.address)) as gateway:
        listener = Listener(broker, "multidrop/#")
        command = [
            require_program("mosquitto_pub"),
            "-p",
            str(broker.port),
            "-t",
            "multidrop/pump-1/act",
            "-l",
        ]
        publisher = subprocess.Popen(command, stdin=subprocess.PIPE, text=True)
        assert publisher.stdin

        def start() -> None:
            assert publisher.stdin
            sent = {"verb": "start", "drive": "pump-1", "time": time.time_ns() // 1_000_000}
            publisher.stdin.write(json.dumps(sent) + "\n")
            publisher.stdin.flush()

        def told() -> str:
            found = listener.wait_for(lambda one: one.topic == "multidrop/pump-1/told")
            return str(json.loads(found.payload)["text"])

        motor = gateway.sims["pump-1"].motor  # type: ignore[attr-defined]
        try:
            listener.wait_for(lambda one: one.topic == "multidrop/gateway" and one.payload == b"online")
            value = {"drive": "pump-1", "register": "setpoint", "value": 50.0}
            writer = {"authorization": gateway.bearer(Right.WRITE)}
            assert gateway.command("/api/write", value, **writer).json["done"] is True
            start()
            assert told() == "pump-1: start is done"
            until(lambda: motor.goal)

            broker.signal(signal.SIGSTOP)
            start()
            assert gateway.post("/api/stop").json["pump-1"]["done"] is True
            broker.signal(signal.SIGCONT)
            assert told().startswith("not sent: it ")
            assert not motor.goal
        finally:
            broker.signal(signal.SIGCONT)
            publisher.stdin.close()
            publisher.wait()
            listener.close()
