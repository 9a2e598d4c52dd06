"""The route of frames, without the router's objects: most requests by far are for a frame."""

from __future__ import annotations

from urllib.parse import parse_qs

from starlette.datastructures import Headers
from starlette.types import Receive, Scope, Send

from multidrop.gateway.http.guard import Denied
from multidrop.gateway.http.json_response import JsonResponse
from multidrop.gateway.http.request_fields import number_in
from multidrop.gateway.live.frames import WHOLE, Frames

_PLAIN = [(b"content-type", b"application/json"), (b"vary", b"accept-encoding")]
_GZIPPED = [*_PLAIN, (b"content-encoding", b"gzip")]


class FrameRoute:
    """Answers `/api/frame?after=N` with a frame other than the N-th, as soon as there is one."""

    def __init__(self, frames: Frames) -> None:
        self._frames = frames

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            asked = parse_qs(scope["query_string"].decode("latin-1"), keep_blank_values=True)
            frame = await self._frames.after(number_in(asked.get("after", [str(WHOLE)])[-1], "after"))
        except Denied as denied:
            await JsonResponse({"error": str(denied)}, denied.status)(scope, receive, send)
            return
        except OverflowError as full:
            await JsonResponse({"error": str(full)}, 503)(scope, receive, send)
            return
        status, headers, body = 304, list[tuple[bytes, bytes]](), b""
        if frame is not None:
            takes_gzip = "gzip" in Headers(scope=scope).get("accept-encoding", "")
            status, headers = 200, _GZIPPED if takes_gzip else _PLAIN
            body = frame.gzipped if takes_gzip else frame.plain
            headers = [*headers, (b"content-length", str(len(body)).encode())]
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": body})
