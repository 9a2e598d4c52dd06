"""Parameters over HTTP: read on request only, and exported as files."""

from __future__ import annotations

from pathlib import Path

import pytest
from gateways import Served, served
from lines import until

from multidrop import InvtCHE
from multidrop.drive import parameters
from multidrop.drive.parameters import ParameterGroup, ParameterSpace

PATH = "/api/parameters/pump-1"


def state(gateway: Served) -> str:
    return str(gateway.get(PATH).json["state"])


def test_parameters_are_read_on_request_and_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    space = ParameterSpace(groups=(ParameterGroup("P.", 0x2000, range(3)),))
    monkeypatch.setattr(InvtCHE, "parameter_space", space)
    parameters._parameters_of.cache_clear()
    with served(tmp_path) as gateway:
        gateway.sims["pump-1"]["setpoint"] = 12.5
        assert state(gateway) == "none"
        assert gateway.get(f"{PATH}?format=toml").status == 409
        assert gateway.get(f"{PATH}?read=1").json["state"] in ("reading", "read")
        until(lambda: state(gateway) == "read")
        (row,) = gateway.get(PATH).json["parameters"]
        assert (row["code"], row["name"], row["value"]) == ("P.00", "setpoint", "12.50 %")
        answer = gateway.get(f"{PATH}?format=csv")
        assert b"\nP.00;1250;setpoint;12.50 %;\n" in answer.body
        assert "attachment" in answer.headers["content-disposition"]
        assert b'"P.00" = 1250' in gateway.get(f"{PATH}?format=toml").body
        assert gateway.get(f"{PATH}?format=exe").status == 400
        assert gateway.sims["pump-1"].counters.functions[6] == 0
    parameters._parameters_of.cache_clear()


def test_parameters_of_a_family_without_known_addresses_are_refused(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        gateway.get(f"{PATH}?read=1")
        until(lambda: state(gateway) == "failed")
        assert "no reliable rule" in gateway.get(PATH).json["error"]
        assert gateway.get("/api/parameters/nobody").status == 404
