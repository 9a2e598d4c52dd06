"""Append CRC, LRC or Delixi's sum to frames, computed from the documents, without the library."""

from __future__ import annotations


def rtu(body: str | bytes) -> bytes:
    """Return the frame with its CRC, computed bit by bit (INVT CHE manual, 11.6.3)."""
    octets = bytes.fromhex(body) if isinstance(body, str) else body
    crc = 0xFFFF
    for octet in octets:
        crc ^= octet
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return octets + crc.to_bytes(2, "little")


def ascii(body: str) -> bytes:
    """Return the frame with its LRC, which makes the sum of octets 0 (INNOVERT IBD manual, appendix 2)."""
    return f":{body}{-sum(bytes.fromhex(body)) & 0xFF:02X}\r\n".encode()


def delixi(body: str) -> bytes:
    """Return the frame with the sum of its bytes modulo 256 (Delixi's manual, part 3)."""
    return f":{body}{sum(bytes.fromhex(body)) & 0xFF:02X}\r\n".encode()
