"""How a run ends: from whatever its procedure raised to a status, an error and perhaps a fault."""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from typing import Any

from cellctl.errors import CellctlError, DeviceFault, NotEnabled
from cellctl.messages import RunStatus


@dataclass(frozen=True)
class Ending:
    """`status` is the journal line's kind too. `fault` is for a person to acknowledge."""

    status: RunStatus
    error: str | None = None
    code: str | None = None
    fault: str | None = None
    traceback: str | None = None
    verdict: str | None = None
    reasons: tuple[str, ...] = ()
    calibration_id: str | None = None

    def as_data(self) -> dict[str, Any]:
        """What the journal and the event say of it, empty members left out."""
        members = {name: value for name, value in vars(self).items() if name != "status"}
        return {name: value for name, value in members.items() if value not in (None, ())}


def ending_of(error: BaseException) -> Ending:
    """A device fault interrupts, and a person has to look; a missing permission interrupts; any
    other deliberate error fails the run; anything else is a defect of the program."""
    cause = _leading(error)
    if isinstance(cause, DeviceFault):
        return Ending("interrupted", cause.message, cause.code, fault=cause.message)
    if isinstance(cause, NotEnabled):
        return Ending("interrupted", cause.message, cause.code)
    trace = "".join(traceback.format_exception(error))
    if isinstance(cause, CellctlError):
        trace = cause.details.get("traceback", trace)
        return Ending("failed", cause.message, cause.code, traceback=trace)
    summary = "".join(traceback.format_exception_only(cause)).strip()
    message = f"a defect of the program: {summary} (the journal has the traceback)"
    return Ending("failed", message, CellctlError.code, traceback=trace)


def _leading(error: BaseException) -> BaseException:
    """The error that decides among those of an exception group: a defect, then a device fault."""
    leaves = list(_leaves(error))
    for wanted in (_is_defect, _is_fault):
        for leaf in leaves:
            if wanted(leaf):
                return leaf
    return leaves[0]


def _leaves(error: BaseException) -> list[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        return [leaf for inner in error.exceptions for leaf in _leaves(inner)]
    return [error]


def _is_defect(error: BaseException) -> bool:
    return not isinstance(error, CellctlError)


def _is_fault(error: BaseException) -> bool:
    return isinstance(error, DeviceFault)
