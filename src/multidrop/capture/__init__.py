"""Captures: the bytes that went over a line, in files that Wireshark opens.

`CaptureWriter` writes pcapng with link type 252 (Wireshark's "exported PDU"), one packet per frame, with time
stamps in ns and direction. Each line is an interface with the line's name. Wireshark decodes RTU frames as
Modbus RTU without configuration. With the preference `mbrtu.tcp.port` set to 502 it also distinguishes
requests from replies if both look alike (functions 05, 06 and 08):

    tshark -r line.pcapng -o mbrtu.tcp.port:502

Broadcasts, ASCII frames, Delixi's own frames and bytes outside of frames are shown as bytes.

`Tapped` taps polled lines: their traffic goes into a capture or to a `FlightRecorder`. A flight recorder
keeps the traffic of the last minutes, and writes it into a file after an anomaly.

`Capture` reads these files, and pcap and pcapng files of other programs: link type 250 (RTAC serial), link
type 252, and packets of bytes without a header under other link types, such as the user types 147 to 162.
A packet may hold a part of a frame, or several frames.
"""

from __future__ import annotations

from multidrop.capture.decoding import Decoding as Decoding
from multidrop.capture.decoding import Junk as Junk
from multidrop.capture.decoding import Pairing as Pairing
from multidrop.capture.decoding import Sniffed as Sniffed
from multidrop.capture.decoding import SniffedExchange as SniffedExchange
from multidrop.capture.pcapng import Capture as Capture
from multidrop.capture.pcapng import CaptureError as CaptureError
from multidrop.capture.pcapng import CaptureWriter as CaptureWriter
from multidrop.capture.tap import FlightRecorder as FlightRecorder
from multidrop.capture.tap import Tapped as Tapped
from multidrop.core import Side as Side
