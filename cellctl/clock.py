"""The cell's clock: the one in which device time stamps are given, in seconds."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """`now()` in cell seconds; deadlines and heartbeats use `time.monotonic` instead."""

    def now(self) -> float: ...


class MonotonicClock:
    """The clock of a real cell: CLOCK_MONOTONIC, which V4L2 and KMS stamp with too."""

    def now(self) -> float:
        return time.monotonic()
