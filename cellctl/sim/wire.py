"""Frames on the simulated cell's sockets: two lengths, a JSON header, a blob.

`u32 header length, u32 blob length` (big-endian), then the header, a JSON object in UTF-8, then
the blob: the pixels of an image, or nothing.

A request's header is `{"id": n, "verb": "robot.move", ...its arguments}`. Its reply repeats the
id: `{"id": n, "t": cell time, ...}`, or `{"id": n, "error": {"code": ..., "message": ...}}`.
"""

from __future__ import annotations

import asyncio
import json
import struct
from typing import Any

from cellctl.errors import BadInput

LENGTHS = struct.Struct("!II")
MAX_HEADER = 1 << 20
MAX_BLOB = 1 << 26
HOST = "127.0.0.1"


class BrokenFrame(BadInput):
    """What follows on this connection cannot be understood any more."""


def pack(header: dict[str, Any], blob: bytes = b"") -> bytes:
    """One frame. BadInput when it would be refused."""
    try:
        text = json.dumps(header, allow_nan=False).encode()
    except ValueError:
        raise BadInput(f"{header.get('verb')}: a number is not finite") from None
    if len(text) > MAX_HEADER or len(blob) > MAX_BLOB:
        raise BadInput(_too_long(len(text), len(blob)))
    return LENGTHS.pack(len(text), len(blob)) + text + blob


async def read_frame(reader: asyncio.StreamReader) -> tuple[dict[str, Any], bytes]:
    """The next frame. BadInput when its header is not a JSON object, BrokenFrame when it is too
    long; IncompleteReadError when the other end has gone."""
    lengths = LENGTHS.unpack(await reader.readexactly(LENGTHS.size))
    if lengths[0] > MAX_HEADER or lengths[1] > MAX_BLOB:
        raise BrokenFrame(_too_long(*lengths))
    text, blob = await reader.readexactly(lengths[0]), await reader.readexactly(lengths[1])
    try:
        header = json.loads(text)
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise BadInput(f"the header is not JSON: {error}") from None
    if not isinstance(header, dict):
        raise BadInput(f"the header must be a JSON object, not {type(header).__name__}")
    return header, blob


def _too_long(header: int, blob: int) -> str:
    return (
        f"frame refused: header of {header} bytes (at most {MAX_HEADER}), "
        f"blob of {blob} bytes (at most {MAX_BLOB})"
    )
