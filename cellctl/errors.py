"""Every error that cellctl raises on purpose, with its wire code and its exit code.

The message is written for a tired person: what is wrong, where, and what to do.
"""

from __future__ import annotations

from typing import Any, ClassVar


def printable(value: Any) -> Any:
    """`value`, its strings such that every file, terminal and peer takes them: a byte of a path
    that is not UTF-8 is spelt out as `\\udce9`. Looks into dicts, lists and tuples."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        names = (printable(key) if isinstance(key, str) else key for key in value)
        return dict(zip(names, map(printable, value.values()), strict=True))
    if isinstance(value, list | tuple):
        return [printable(item) for item in value]
    return value


class CellctlError(Exception):
    """Base of all deliberate errors. `details` travels with the error over the bus."""

    code: ClassVar[str] = "internal"
    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, **details: Any) -> None:
        self.message: str = printable(message)
        self.details: dict[str, Any] = printable(details)
        super().__init__(self.message)


class BadInput(CellctlError):
    """A config, data set, message, image or option that cannot be used as it is."""

    code = "bad_request"
    exit_code = 2


class Busy(CellctlError):
    """Another run owns the cell."""

    code = "busy"
    exit_code = 3


class NotEnabled(CellctlError):
    """Motion was asked for without `cellctl enable`."""

    code = "not_enabled"
    exit_code = 4


class Denied(CellctlError):
    """The daemon lives but refuses this identity."""

    code = "denied"
    exit_code = 4


class Unreachable(CellctlError):
    """Nobody answers at the other end."""

    code = "unreachable"
    exit_code = 5


class NotFound(CellctlError):
    """No such run, procedure or calibration."""

    code = "not_found"
    exit_code = 6


class DeviceFault(CellctlError):
    """A device, its link or its worker failed. The run stops and can be resumed."""

    code = "device_fault"


class StorageFault(DeviceFault):
    """The data directory cannot be written. What was journalled before stays as it is."""

    code = "storage_fault"


class MotionRefused(CellctlError):
    """The guard, or the controller, refuses a path. Nothing has moved."""

    code = "motion_refused"


class FrameError(CellctlError):
    """Transforms were composed in an order that their frames do not allow."""


class SolveError(CellctlError):
    """The data do not determine the answer that was asked for."""

    code = "solve_failed"


BY_CODE: dict[str, type[CellctlError]] = {
    kind.code: kind
    for kind in (
        CellctlError,
        BadInput,
        Busy,
        NotEnabled,
        Denied,
        Unreachable,
        NotFound,
        DeviceFault,
        StorageFault,
        MotionRefused,
        SolveError,
    )
}
