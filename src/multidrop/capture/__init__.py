"""Captures: what was said on a line, byte for byte, in files that Wireshark opens.

`CaptureWriter` writes pcapng with link type 252 (Wireshark's "exported PDU"), one packet a frame, with
ns time stamps, direction, and the line's name as the interface's. Wireshark decodes RTU frames as
Modbus RTU without further ado; with the preference `mbrtu.tcp.port` set to 502 it also tells requests
from replies where both look alike (functions 05, 06 and 08):

    tshark -r line.pcapng -o mbrtu.tcp.port:502

Broadcasts, ASCII frames, Delixi's own and what is no frame are shown as the bytes they are.

`Tapped` taps lines that are polled: what goes over them goes into a capture, or is kept by a
`FlightRecorder`, which writes the last minutes when something goes wrong.

`Capture` reads these, and pcap and pcapng files of others: link type 250 (RTAC serial), 252, and
frames without a header under any other, such as the user link types 147 to 162. Frames need not lie
in packets one by one.
"""

from __future__ import annotations

from multidrop.capture.decoding import Decoding
from multidrop.capture.flight_recorder import FlightRecorder
from multidrop.capture.pairing import Junk, Pairing, Sniffed, SniffedExchange
from multidrop.capture.pcapng_reader import Capture, CaptureError
from multidrop.capture.pcapng_writer import CaptureWriter
from multidrop.capture.tap import Tapped
from multidrop.core import Side

__all__ = [
    "Capture",
    "CaptureError",
    "CaptureWriter",
    "Decoding",
    "FlightRecorder",
    "Junk",
    "Pairing",
    "Side",
    "Sniffed",
    "SniffedExchange",
    "Tapped",
]
