"""JSON responses, whatever texts are in them: names from requests and of files may be no UTF-8."""

from __future__ import annotations

import json
from typing import Any

from starlette.responses import Response


class JsonResponse(Response):
    """An answer of ASCII alone; what is no Unicode is told by its escape."""

    media_type = "application/json"

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
