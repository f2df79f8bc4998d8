"""Zenoh sessions that do only what they are told: one endpoint, on loopback, no discovery.

Zenoh's defaults listen on every interface and announce themselves by multicast. Here everything
is spelt out, and what Zenoh says when it cannot open is turned into an error for a person.
"""

from __future__ import annotations

import ipaddress
import json
import re
import socket
from collections.abc import Mapping

import zenoh

from cellctl.errors import BadInput, Unreachable
from cellctl.local import DEFAULT_ENDPOINT

MAX_REQUEST_BYTES = 1 << 20
MAX_ANSWER_BYTES = 64 << 20

Settings = Mapping[str, object]
"""Zenoh configuration by path, as `{"transport/link/tls": {...}, "access_control": {...}}`."""

COMMON: Settings = {
    "listen/exit_on_failure": True,
    "connect/timeout_ms": 2000,
    "connect/retry": {"period_init_ms": 250, "period_max_ms": 1000, "period_increase_factor": 2},
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "adminspace/enabled": False,
    "transport/unicast/max_sessions": 32,
    "transport/unicast/open_timeout": 2000,
    "transport/link/protocols": ["tcp"],
    # After so many ms without a sign of life the other side counts as gone.
    "transport/link/tx/lease": 3000,
    # A link that takes nothing for so many us while a reply waits for it is closed. Some
    # megabytes of answers are then unread: on loopback, the other side has stopped.
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 500_000,
    # Nothing here is large, and a killed process leaves its shared segments behind.
    "transport/shared_memory/enabled": False,
}

_ENDPOINT = re.compile(r"tcp/(?P<host>\[[0-9a-fA-F:.]+\]|[^\[\]:/?#]+):(?P<port>\d{1,5})")
_SOURCE_PLACE = re.compile(r"\s+at /\S+?\.rs:\d+")


def open_listening(endpoint: str, settings: Settings | None = None) -> zenoh.Session:
    """The daemon's session. BadInput when the endpoint is malformed, not loopback or taken.

    `settings` are laid over those given here: the place for TLS and access control.
    """
    check_endpoint(endpoint)
    daemon: Settings = {
        "mode": "peer",
        "listen/endpoints": [endpoint],
        "connect/endpoints": [],
        "transport/link/rx/max_message_size": MAX_REQUEST_BYTES,
    }
    try:
        return zenoh.open(_config(COMMON, daemon, settings or {}))
    except zenoh.ZError as error:
        raise BadInput(_cannot_listen(endpoint, plain(error)), endpoint=endpoint) from None


def open_connected(endpoint: str, settings: Settings | None = None) -> zenoh.Session:
    """A client's session. Unreachable when nobody listens there, BadInput when malformed."""
    check_endpoint(endpoint)
    client: Settings = {
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "transport/link/rx/max_message_size": MAX_ANSWER_BYTES,
    }
    try:
        return zenoh.open(_config(COMMON, client, settings or {}))
    except zenoh.ZError as error:
        raise Unreachable(
            f"nobody answers at {endpoint}. Is `cellctl serve` running there? Another endpoint is "
            "given with --connect or CELLCTL_CONNECT.",
            reason=plain(error),
            endpoint=endpoint,
        ) from None


def check_endpoint(endpoint: str) -> None:
    """BadInput unless `endpoint` is tcp/HOST:PORT with a loopback HOST."""
    match = _ENDPOINT.fullmatch(endpoint)
    if not match:
        raise BadInput(f"endpoint {endpoint!r}: expected tcp/HOST:PORT, as {DEFAULT_ENDPOINT}")
    if not 0 < int(match["port"]) < 65536:
        raise BadInput(f"endpoint {endpoint!r}: the port must be 1 to 65535")
    if not _is_loopback(match["host"].strip("[]")):
        raise BadInput(
            f"endpoint {endpoint!r}: only loopback (127.0.0.1, [::1], localhost) is allowed, "
            "since nothing here tells one caller from another; from another machine, use an SSH "
            "tunnel"
        )


def free_endpoint() -> str:
    """A loopback endpoint that nobody listens at just now, for demos and tests."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def plain(error: BaseException) -> str:
    """A Zenoh error without the places in its source code that it ends in."""
    return _SOURCE_PLACE.sub("", str(error)).rstrip(". ")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _cannot_listen(endpoint: str, reason: str) -> str:
    if "in use" in reason:
        return (
            f"cannot listen at {endpoint}: the port is in use. Is another `cellctl serve` running? "
            "Stop it, or set [bus] listen to a free port."
        )
    return f"cannot listen at {endpoint}: {reason}"


def _config(*layers: Settings) -> zenoh.Config:
    """Later layers win."""
    config = zenoh.Config()
    for layer in layers:
        for path, value in layer.items():
            config.insert_json5(path, json.dumps(value))
    return config
