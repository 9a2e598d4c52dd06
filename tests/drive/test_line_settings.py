"""Character times and silences against the serial-line guide's own figures."""

import pytest
from tables import table

from multidrop.drive.line_settings import Settings


@table(
    ("baudrate", "format", "bits"),
    [
        (9600, "8N1", 10),
        (9600, "8E1", 11),
        (9600, "8N2", 11),
        (9600, "7N2", 10),
        (9600, "7E1", 10),
        (9600, "8O2", 12),
    ],
)
def test_a_character_has_its_bits(baudrate: int, format: str, bits: int) -> None:
    assert Settings(baudrate, format).character == pytest.approx(bits / baudrate)


@table(
    ("baudrate", "format", "seconds"),
    [
        (9600, "8E1", 4.0104e-3),  # 3.5 characters of 11 bits
        (19200, "8E1", 2.0052e-3),
        (38400, "8N1", 1.75e-3),  # fixed above 19200
        (115200, "8N1", 1.75e-3),
    ],
)
def test_t3_5(baudrate: int, format: str, seconds: float) -> None:
    assert Settings(baudrate, format).t3_5 == pytest.approx(seconds, rel=1e-4)


@table("format", ["8X1", "9N1", "8N3", "8n1", "", "8N1 "])
def test_invalid_format_is_refused(format: str) -> None:
    with pytest.raises(ValueError, match="format"):
        Settings(9600, format)


@pytest.mark.parametrize("baudrate", [0, -9600, 10**9])
def test_invalid_baud_rate_is_refused(baudrate: int) -> None:
    with pytest.raises(ValueError, match="baud rate"):
        Settings(baudrate, "8N1")
