"""The key space of one cell. `@v1` is a verbatim chunk: no `**` of another version crosses it.

cell/{cell}/@v1/live/{boot}            liveliness token of one daemon process
                state, state/robot     snapshots, newest wins
                event                  numbered by (boot, seq)
                run/{run}/progress
                frame/{camera}         image/jpeg
                get/...  cmd/...       queries, see `cellctl.bus.requests`
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from cellctl.errors import BadInput

VERSION = "@v1"
LIVE_ANYWHERE = f"cell/*/{VERSION}/live/*"

_CELL = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


def check_name(value: str, what: str) -> str:
    """`value` when it can be one chunk of a key and the name of a file; else BadInput."""
    if not _NAME.fullmatch(value):
        raise BadInput(
            f"{what} {value[:80]!r} is not a name: letters, digits, '.', '_' and '-', "
            "at most 128, starting with a letter or a digit"
        )
    return value


@dataclass(frozen=True)
class Keys:
    """All keys of the cell `cell`. BadInput when that is not a cell id."""

    cell: str

    def __post_init__(self) -> None:
        if not _CELL.fullmatch(self.cell):
            raise BadInput(
                f"cell id {self.cell[:80]!r}: use lower-case letters, digits and '-', at most 32"
            )

    @property
    def root(self) -> str:
        return f"cell/{self.cell}/{VERSION}"

    @property
    def state(self) -> str:
        return f"{self.root}/state"

    @property
    def robot(self) -> str:
        return f"{self.root}/state/robot"

    @property
    def event(self) -> str:
        return f"{self.root}/event"

    @property
    def live_anyone(self) -> str:
        return f"{self.root}/live/*"

    def live(self, boot: str) -> str:
        return f"{self.root}/live/{check_name(boot, 'boot id')}"

    def progress(self, run_id: str) -> str:
        return f"{self.root}/run/{check_name(run_id, 'run id')}/progress"

    @property
    def progress_of_all(self) -> str:
        return f"{self.root}/run/*/progress"

    def frame(self, camera: str) -> str:
        return f"{self.root}/frame/{check_name(camera, 'camera')}"

    def request(self, path: str) -> str:
        """The key of a query such as `get/state` or `cmd/run/full`."""
        return f"{self.root}/{path}"

    @property
    def requests(self) -> tuple[str, str]:
        """What the daemon answers. Two keys, so that an ACL can tell reading from commanding."""
        return f"{self.root}/get/**", f"{self.root}/cmd/**"


def parse_live(key: str) -> tuple[str, str]:
    """(cell, boot) of a liveliness token's key."""
    _, cell, _, _, boot = key.split("/")
    return cell, boot
