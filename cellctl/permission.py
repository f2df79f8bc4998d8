"""Permission to move: a file that expires, written on the cell's own machine only.

`motion-permission.json` in the data directory says who enabled motion and until when. There is
no command on the bus that writes it.
"""

from __future__ import annotations

import math
import re
import shlex
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cellctl.errors import BadInput, NotEnabled
from cellctl.local import user
from cellctl.store.files import Schema, read_document, storage, write_document

SCHEMA = Schema("cellctl-permission", 1)
FILE = "motion-permission.json"
LONGEST_S = 7 * 24 * 3600.0
CLOCK_TOLERANCE_S = 60.0
UNITS_S = {"h": 3600.0, "m": 60.0, "s": 1.0}


def parse_duration(text: str) -> float:
    """Seconds in `8h`, `90m`, `1h30m` or `45s`. BadInput for anything else."""
    parts = re.fullmatch(r"(?:(\d{1,6})h)?(?:(\d{1,6})m)?(?:(\d{1,6})s)?", text.strip())
    if not text.strip() or parts is None:
        raise BadInput(f"{text!r} is not a duration; write for example 8h, 90m or 1h30m")
    return sum(
        int(count or 0) * unit for count, unit in zip(parts.groups(), UNITS_S.values(), strict=True)
    )


@dataclass(frozen=True)
class Grant:
    """Motion is permitted from `since` to `until` (wall clock, s) by the user `by`."""

    since: float
    until: float
    by: str


def enable(directory: Path, duration_s: float, *, now: float | None = None) -> Grant:
    """Permit motion in the cell of this data directory for a while, at most 7 days."""
    if not 0 < duration_s <= LONGEST_S:
        raise BadInput(f"motion can be enabled for up to {LONGEST_S / 3600:.0f}h at a time")
    since = time.time() if now is None else now
    grant = Grant(since, since + duration_s, user())
    with storage(directory):
        directory.mkdir(parents=True, exist_ok=True)
    content = {"since": grant.since, "until": grant.until, "by": grant.by}
    write_document(directory / FILE, SCHEMA, content)
    return grant


class Permission:
    """Whether this cell may move now. `always` is for simulated cells (`cell.motion_enabled`)."""

    def __init__(self, directory: Path, *, always: bool = False) -> None:
        self._path = directory / FILE
        self._always = always
        self._grant_read: Grant | None = None
        self._version: tuple[int, ...] = ()
        self.command = (
            f"CELLCTL_DATA={shlex.quote(str(directory.absolute()))} cellctl enable --for 8h"
        )
        """What a person types on the cell's machine to permit motion."""

    def until(self, now: float | None = None) -> float | None:
        """Wall-clock second at which the permission ends, `inf` for always, None without one."""
        if self._always:
            return math.inf
        try:
            return self._grant(time.time() if now is None else now).until
        except NotEnabled:
            return None

    def require(self, now: float | None = None) -> None:
        """NotEnabled, with the command to type, unless motion is permitted now."""
        if not self._always:
            self._grant(time.time() if now is None else now)

    def _grant(self, now: float) -> Grant:
        grant = self._on_disk()
        if grant.until <= now:
            raise self._not_enabled(f"motion was enabled until {_clock(grant.until)}")
        if grant.since > now + CLOCK_TOLERANCE_S or grant.until - grant.since > LONGEST_S:
            raise self._not_enabled(
                f"{self._path}: enabled from {_clock(grant.since)} to {_clock(grant.until)}: "
                "the clock was changed, or it was not cellctl that wrote it"
            )
        return grant

    def _on_disk(self) -> Grant:
        """The grant, read again only when the file is another one: states are told often."""
        try:
            found = self._path.stat()
        except FileNotFoundError:
            raise self._not_enabled("motion is not enabled") from None
        except OSError as error:
            raise self._not_enabled(f"{self._path}: cannot be read: {error.strerror}") from None
        version = (found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size)
        if self._grant_read is None or version != self._version:
            self._grant_read, self._version = self._read(), version
        return self._grant_read

    def _read(self) -> Grant:
        try:
            document = read_document(self._path, SCHEMA)
            since, until = _seconds(document["since"]), _seconds(document["until"])
            grant = Grant(since, until, str(document["by"]))
        except BadInput as error:
            raise self._not_enabled(error.message) from None
        except (KeyError, TypeError, ValueError, OverflowError):
            raise self._not_enabled(f"{self._path}: malformed") from None
        return grant

    def _not_enabled(self, reason: str) -> NotEnabled:
        return NotEnabled(
            f"{reason}. On the cell's machine type: {self.command}", command=self.command
        )


def _seconds(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is no point in time")
    return float(value)


def _clock(seconds: float) -> str:
    try:
        moment = datetime.fromtimestamp(seconds, UTC).astimezone()
    except (OverflowError, ValueError, OSError):
        return f"{seconds:g} s"
    return moment.isoformat(sep=" ", timespec="seconds")
