"""The door to the arm. It is open to one run at a time, from its start until it begins to end."""

from __future__ import annotations

from contextvars import ContextVar

from cellctl.errors import NotEnabled
from cellctl.permission import Permission

_PASS: ContextVar[object] = ContextVar("pass of the run that this task belongs to", default=None)


class Gate:
    """Who may move the arm now: the active run, if a person permits motion.

    `admit` gives a pass to the task that calls it and to those that it starts from there on. The
    pass is worth nothing after `shut`, so a task that outlives its run moves nothing, then or
    during a later run. The engine owns the gate; stopping the arm needs no pass.
    """

    def __init__(self, permission: Permission) -> None:
        self.permission = permission
        self._valid: object | None = None

    def admit(self) -> None:
        """Open for the current task; whoever was admitted before is so no longer."""
        self._valid = object()
        _PASS.set(self._valid)

    def shut(self) -> None:
        """Nothing moves from here on. Idempotent."""
        self._valid = None

    def require(self) -> None:
        """NotEnabled unless the current task has been admitted and motion is permitted."""
        if self._valid is None or _PASS.get() is not self._valid:
            raise NotEnabled("the arm only moves for a run that is active and not being stopped")
        self.permission.require()
