"""The table [serve.modbus]: its mistakes, and the clients that may connect."""

from __future__ import annotations

import pytest
from tables import table

from multidrop.gateway.modbus_server.settings import ModbusSettings


@table(
    ("settings", "sentence"),
    [
        ({"listen": "1502"}, "is not ADDRESS:PORT"),
        ({"listen": "example.org:1502"}, "is not ADDRESS:PORT"),
        ({"listen": "127.0.0.1:70000"}, "a port is a number from 1 to 65535"),
        ({"listen": "0.0.0.0:1502"}, "is open to other machines, and Modbus has no tokens"),
        ({"listen": "[::]:1502"}, "is open to other machines"),
        ({"passing": "all"}, "passing = 'all' is not one of off, declared, any"),
        ({"may": "root"}, "may = 'root' is not one of look, stop, write"),
        ({"units": {"pump": 0}}, "pump = 0 is not a unit id"),
        ({"units": {"pump": True}}, "pump = True is not a unit id"),
        ({"ports": {"hall": 1502}}, "hall = 1502 is in use by listen"),
        ({"ports": {"hall": "x"}}, "hall = 'x' is not a port"),
        ({"clients": ("10.0.0.0/33",)}, "'10.0.0.0/33' is neither an address nor a network"),
        ({"common": 0xFFF8}, "is not an address"),
    ],
)
def test_a_mistake_in_the_settings_is_one_sentence(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=r"^\w+") as mistake:
        ModbusSettings(**settings)  # type: ignore[arg-type]
    assert sentence in str(mistake.value)


def test_all_mistakes_are_reported_together() -> None:
    with pytest.raises(ValueError, match="listen") as mistake:
        ModbusSettings(listen="x", passing="all", may="root", clients=("y",))
    assert len(str(mistake.value).splitlines()) == 4


def test_only_listed_clients_may_connect_or_local_ones_without_a_list() -> None:
    alone = ModbusSettings()
    assert [alone.may_connect(address) for address in ("127.0.0.1", "::1", "10.0.0.5")] == [True, True, False]
    named = ModbusSettings(listen="0.0.0.0:1502", clients=("10.0.0.0/24", "fe80::1"))
    for address, may in (
        ("10.0.0.5", True),
        ("::ffff:10.0.0.5", True),
        ("10.0.1.5", False),
        ("fe80::1%eth0", True),
        ("127.0.0.1", False),
    ):
        assert named.may_connect(address) is may
