"""The gateway's part `upload`: sends all polled values to a URL by POST, as batches in JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

from multidrop import Plant
from multidrop.gateway.forward.forwarder import Forwarding, Outgoing, RepeatingReceiver, pieces, row_objects
from multidrop.gateway.parts import PartContext
from multidrop.gateway.sending import host_of, post, url_mistakes
from multidrop.gateway.settings import parsing_mistakes, refuse, secret_in, secret_mistakes
from multidrop.recording import parse_size
from multidrop.toml_check import SIZE


@dataclass(frozen=True)
class UploadSettings:
    """The settings in the table `[serve.upload]`. Raises ValueError with a line for each mistake."""

    url: str = "http://localhost:1880/rows"
    token: str = ""  # path of the file with a bearer token
    spool: str = "spool/upload"
    most: str = field(default="1 GB", metadata=SIZE)

    def __post_init__(self) -> None:
        wrong = url_mistakes(self.url, "https://plant.example/rows")
        refuse((*wrong, *parsing_mistakes(self, most=parse_size)))

    def check(self, plant: Plant) -> list[str]:
        return [*secret_mistakes("token", self.token, plant)]


Settings = UploadSettings


def build(settings: UploadSettings, context: PartContext) -> Forwarding:
    """Return the forwarder that posts rows to `settings.url`. Raises OSError if the token cannot be read."""
    token = secret_in(settings.token, context.plant)
    headers = {"content-type": "application/json"} | ({"authorization": f"Bearer {token}"} if token else {})

    def deliver(message: Outgoing) -> None:
        for number, rows in enumerate(pieces(message.rows)):
            name = f"{message.id}-{number}"
            batch = {
                "id": name,
                "plant": context.plant.path.stem,
                "historical": message.is_historical,
                "rows": row_objects(rows),
            }
            post(settings.url, json.dumps(batch).encode(), {**headers, "idempotency-key": name})

    folder, receiver = context.folder / settings.spool, host_of(settings.url)
    return Forwarding(
        "upload", receiver, folder, settings.most, context.plant, lambda at: RepeatingReceiver(at, deliver)
    )
