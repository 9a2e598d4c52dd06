"""Simulated lines on real ptys and TCP ports, with a client that is independent of the simulator."""

from __future__ import annotations

import multiprocessing
import os
import socket
import struct
import time
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

import checksums
import pytest
from kills import descriptors, threads
from lines import until
from ptys import opened, receive
from tables import table

from multidrop.core import Framing, Message, build_request, parse_reply, reply_length, set_settings
from multidrop.families.delixi_native import DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.sim import EncodedDrive, Simulator, Wire, encoded, serve, simulated

READ = Message(1, 0x03, 0x3000, 2)  # a read of a CHE


def wire(*, unpaced: bool = True, port: str = "pty") -> Wire:
    return Wire([EncodedDrive(InvtCHE(1))], unpaced=unpaced, port=port)


def expected(address: int = 1) -> bytes:
    table = InvtCHE.output_frequency.table
    return b"".join(encoded(address, table, at).to_bytes(2) for at in (0x3000, 0x3001))


def exchange(fd: int, request: Message, framing: Framing = Framing.RTU) -> Message:
    os.write(fd, build_request(framing, request))
    received = receive(fd, reply_length(framing, request))
    used, reply = parse_reply(framing, received, request)
    assert used == len(received)
    assert reply is not None
    return reply


@table("port", ["pty", "socket://127.0.0.1:0"])
@table("unpaced", [True, False], ids=["unpaced", "paced"])
def test_simulated_port_can_be_opened_and_read_repeatedly(port: str, unpaced: bool) -> None:
    with Simulator([wire(port=port, unpaced=unpaced)]) as sim:
        for _ in range(3):
            with opened(sim.wires[0].path) as fd:
                assert exchange(fd, READ).data == expected()
            time.sleep(0.005)  # silence before the next request on a paced line


def test_ended_simulator_leaves_no_thread_or_descriptor() -> None:
    before = descriptors(), threads()
    for port in ("pty", "socket://127.0.0.1:0"):
        with Simulator([wire(port=port), wire()]) as sim:
            with opened(sim.wires[0].path) as fd:
                exchange(fd, READ)
            assert threads() == before[1] + 1
    assert (descriptors(), threads()) == before


def test_one_thread_simulates_many_lines() -> None:
    wires = [Wire([EncodedDrive(InvtCHE(at))], unpaced=True) for at in range(1, 65)]
    before = threads()
    with Simulator(wires) as sim:
        assert threads() == before + 1
        for at, each in enumerate(sim.wires, 1):
            with opened(each.path) as fd:
                assert exchange(fd, Message(at, 3, 0x3000, 2)).data == expected(at)


def test_paced_reply_is_never_faster_than_the_wire() -> None:
    with Simulator([wire(unpaced=False)]) as sim, opened(sim.wires[0].path) as fd:
        begin = time.monotonic()
        exchange(fd, READ)
        taken = time.monotonic() - begin
    delay = sim.wires[0].drives[0].delay
    assert taken >= (8 + 9) * 10 / 9600 + delay  # no upper limit: the test machine may be busy


def test_second_tcp_client_is_served_after_the_first_disconnects() -> None:
    with Simulator([wire(port="socket://127.0.0.1:0")]) as sim, ExitStack() as clients:
        path = sim.wires[0].path
        with opened(path) as first:
            exchange(first, READ)
            second = clients.enter_context(opened(path))
            os.write(second, build_request(Framing.RTU, READ))
            assert receive(second, 1, patience=0.05) == b""
        assert parse_reply(Framing.RTU, receive(second, 9), READ)[0] == 9


def test_second_tcp_client_is_served_after_the_first_resets_its_connection() -> None:
    """A killed client's connection ends like this: unread bytes are discarded and the connection is reset."""
    with Simulator([wire(port="socket://127.0.0.1:0")]) as sim:
        path = sim.wires[0].path
        host, _, port = path.removeprefix("socket://").partition(":")
        with socket.create_connection((host, int(port))) as first:
            exchange(first.fileno(), READ)
            first.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with opened(path) as second:
            assert exchange(second, READ).data == expected()


class Broken(Wire):
    """A wire with a mistake in the test's own code."""

    def distort(self, reply: bytes) -> bytes:
        raise ZeroDivisionError("a mistake of the test's own")


def ask_in_vain(broken: Wire) -> None:
    with Simulator([broken]) as sim, opened(broken.path) as fd:
        os.write(fd, build_request(Framing.RTU, READ))
        until(lambda: sim.failure)


def test_exception_in_the_simulator_thread_is_raised_on_exit() -> None:
    with pytest.raises(ZeroDivisionError, match="a mistake of the test's own"):
        ask_in_vain(Broken([EncodedDrive(InvtCHE(1))], unpaced=True))


def test_drives_of_three_framings_reply_on_one_line() -> None:
    drives = [
        EncodedDrive(InvtCHE(1)),
        simulated(InnovertIBD(2, framing="ascii")),
        simulated(DelixiNative(3)),
    ]
    with Simulator([Wire(drives, unpaced=True)]) as sim, opened(sim.wires[0].path) as fd:
        assert exchange(fd, READ).data == expected()
        assert exchange(fd, Message(2, 3, 22, 1), Framing.ASCII).data == b"\x18\x00"
        assert exchange(fd, Message(3, 3, data=bytes(4)), Framing.DELIXI).start == 1
        assert exchange(fd, READ).data == expected()


def test_drives_ignore_a_client_at_another_baud_rate() -> None:
    drives = [EncodedDrive(InvtCHE(1)), simulated(ErmanERG220(2))]  # baud rates 9600 and 38400
    state = Message(2, 4, 0x0400, 4)
    with Simulator([Wire(drives, unpaced=True)]) as sim:
        path = sim.wires[0].path
        with opened(path, 38400) as fd:
            os.write(fd, build_request(Framing.RTU, READ))
            assert receive(fd, 1, patience=0.05) == b""
            assert exchange(fd, state).data == bytes(8)
            set_settings(fd, 9600, "8N1")
            assert exchange(fd, READ).data == expected()
            os.write(fd, build_request(Framing.RTU, state))
            assert receive(fd, 1, patience=0.05) == b""


def test_valid_frame_after_garbage_is_answered() -> None:
    with Simulator([wire()]) as sim, opened(sim.wires[0].path) as fd:
        for garbage in (b"\x00", bytes(range(256)), b":::" * 2000, b"\xff" * 5000):
            os.write(fd, garbage)
            time.sleep(0.03)  # more than the silence that ends a frame on an unpaced wire
            assert exchange(fd, READ).data == expected()


def test_unknown_function_gets_an_exception_reply_after_silence() -> None:
    with Simulator([Wire([simulated(ErmanERG220(1))])]) as sim, opened(sim.wires[0].path, 38400) as fd:
        os.write(fd, checksums.rtu("01 2B"))
        assert receive(fd, 5) == checksums.rtu("01 AB 01")


def test_named_pty_is_opened_through_its_link(tmp_path: Path) -> None:
    link = tmp_path / "hall-1"
    with Simulator([wire(port=str(link))]) as sim:
        assert sim.wires[0].path == str(link)
        with opened(str(link)) as fd:
            assert exchange(fd, READ).data == expected()
        with pytest.raises(FileExistsError), Simulator([wire(), wire(port=str(link))]):
            pass
    assert not link.is_symlink()


@pytest.mark.parametrize("url", ["socket://127.0.0.1", "socket://:5020"])
def test_tcp_port_without_host_or_port_is_refused(url: str) -> None:
    with pytest.raises(ValueError, match=r"socket://host:port, such as"), Simulator([wire(port=url)]):
        pass


def _serve(link: str, connection: Connection) -> None:
    serve([wire(port=link)], lambda simulator: connection.send(simulator.wires[0].path))


@pytest.mark.long
def test_terminated_simulator_process_removes_its_link(tmp_path: Path) -> None:
    link = tmp_path / "hall-1"
    ours, theirs = multiprocessing.Pipe()
    arguments = (str(link), theirs)
    process = multiprocessing.get_context("spawn").Process(target=_serve, args=arguments, daemon=True)
    process.start()
    try:
        assert ours.poll(60)
        with opened(ours.recv()) as fd:
            assert exchange(fd, READ).data == expected()
    finally:
        process.terminate()
        process.join()
    assert process.exitcode == 0
    assert not link.is_symlink()
