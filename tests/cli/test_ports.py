"""`multidrop ports`: the list of serial ports and the advice on permissions, with a simulated /sys."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from multidrop.cli import main, ports


@pytest.fixture
def devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the /dev of a simulated computer with an FTDI adapter and an entry for an absent UART."""
    usb = tmp_path / "sys/devices/usb1/1-4"
    for name, text in (
        ("idVendor", "0403"),
        ("idProduct", "6001"),
        ("manufacturer", "FTDI"),
        ("product", "R"),
    ):
        (usb / name).parent.mkdir(parents=True, exist_ok=True)
        (usb / name).write_text(text)
    (tmp_path / "sys/drivers/ftdi_sio").mkdir(parents=True)
    (usb / "tty0").mkdir()
    (usb / "tty0/driver").symlink_to(tmp_path / "sys/drivers/ftdi_sio")
    for name, kind in (("ttyUSB0", None), ("ttyS7", "0\n")):
        tty = tmp_path / "sys/class/tty" / name
        tty.mkdir(parents=True)
        (tty / "device").symlink_to(usb / "tty0")
        if kind:
            (tty / "type").write_text(kind)
        (tmp_path / "dev").mkdir(exist_ok=True)
        (tmp_path / "dev" / name).touch(mode=0o660)
    found = list(ports._linux_ports(tmp_path / "sys", tmp_path / "dev"))
    monkeypatch.setattr(ports, "_linux_ports", lambda: found)
    monkeypatch.setattr("sys.platform", "linux")
    return tmp_path / "dev"


def test_ports_lists_existing_ports_with_adapter_and_driver(
    devices: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ports"]) == 0
    assert capsys.readouterr().out == (
        f"{devices}/ttyUSB0\n  FTDI R (0403:6001); driver ftdi_sio\n  you may open it\n"
    )


def test_without_any_port_the_advice_is_to_plug_one_in(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ports, "_linux_ports", lambda: iter(()))
    monkeypatch.setattr(ports, "_other_ports", lambda: iter(()))
    assert main(["ports"]) == 1
    assert capsys.readouterr().out.startswith("no serial port found; plug the adapter in")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_advice_names_the_group_that_owns_the_port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import grp
    import pwd

    port = tmp_path / "ttyUSB0"
    port.touch(mode=0o600)
    assert "a udev rule" in ports._permission_advice(port)
    group = next(one for one in grp.getgrall() if one.gr_gid)
    os.chown(port, -1, group.gr_gid) if os.getuid() == 0 else pytest.skip("only root may give a file away")
    port.chmod(0o660)
    user = pwd.getpwuid(os.getuid()).pw_name
    assert ports._permission_advice(port).startswith(f"sudo usermod -aG {group.gr_name} {user}")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_advice_in_a_container_whose_user_has_no_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch(mode=0o660)
    monkeypatch.setattr(os, "getuid", lambda: 4_123_456)
    assert f"in group {port.stat().st_gid}" in ports._permission_advice(port)
