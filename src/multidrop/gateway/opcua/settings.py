"""The table [serve.opcua] of a plant file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from multidrop import Plant
from multidrop.gateway.commands import drives_of
from multidrop.gateway.http.rights import is_loopback
from multidrop.toml_check import ADDRESS, parse_address

EXAMPLE = "127.0.0.1:4840"
# names of the nodes that each drive has besides its registers
STATE, FAULT, STOP = MEMBERS = ("State", "Fault", "Stop")


@dataclass(frozen=True)
class OpcUaSettings:
    """The settings of the OPC UA server. Raises ValueError with a line for each mistake."""

    listen: str = field(default=EXAMPLE, metadata=ADDRESS)
    certificate: str = ""  # path of a PEM file, relative to the plant file; "": no encryption
    key: str = ""  # path of the certificate's RSA key
    libraries: ClassVar[tuple[str, ...]] = ("asyncua",)  # imported when the part is built

    def __post_init__(self) -> None:
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key belong together: give both, or none")
        _ = self.address

    @property
    def address(self) -> tuple[str, int]:
        """The address and the port to listen on. Raises ValueError if `listen` is invalid."""
        return parse_address(self.listen, f'listen = "{EXAMPLE}"')

    @property
    def addresses(self) -> dict[str, tuple[str, int]]:
        """Host and port of the listening socket, by the key of its setting."""
        return {"listen": self.address}

    def check(self, plant: Plant) -> list[str]:
        """Return a sentence for each missing file, unprotected address and ambiguous name."""
        return [*self._mistakes_in(plant)]

    def _mistakes_in(self, plant: Plant) -> Iterator[str]:
        if not is_loopback(self.address[0]) and not (self.certificate and "tokens" in plant.serve):
            yield (
                f'listen = "{self.listen}" is open to other machines: that needs certificate and key here '
                f"and tokens in [serve]; or listen on 127.0.0.1"
            )
        for key, name in (("certificate", self.certificate), ("key", self.key)):
            path = plant.path.parent / name
            if name and not path.is_file():
                yield f'{key} = "{name}": there is no file {path}'
        drives = drives_of(plant)
        channels = {polled.drive.name: {one.name for one in polled.channels} for polled in plant.drives}
        for name in drives:
            owner, _, rest = name.rpartition(".")
            if owner in drives and rest in {*drives[owner].registers, *channels[owner], *MEMBERS}:
                yield f'drive "{name}" has the node id of a value of "{owner}": choose another name'
            for channel in channels[name] & {*MEMBERS}:
                yield f'channel "{channel}" of "{name}" has the node id of another value: choose another name'
