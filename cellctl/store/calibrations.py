"""Calibrations on disk: immutable files, and a pointer with its history that says which is active.

calibrations/<id>.json   cellctl-calibration-file/1: provenance, verdict, the calibration itself
active.json              cellctl-active/1: {"active": id, "history": [...]}, newest last
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from cellctl.errors import BadInput, NotFound
from cellctl.messages import CalibrationInfo
from cellctl.store.files import Schema, read_document, sweep, utc_now, write_document

FILE = Schema("cellctl-calibration-file", 1)
ACTIVE = Schema("cellctl-active", 1)
SAFE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


class CalibrationStore:
    """The calibrations of one data directory. It blocks: one thread owns it.

    Raises BadInput when active.json is unreadable or names a calibration that is not there.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory / "calibrations"
        self._pointer = directory / "active.json"
        self._directory.mkdir(exist_ok=True)
        sweep(self._directory)
        self._history = self._read_history()
        if self.active is not None and not self._path(self.active).exists():
            raise BadInput(
                f"{self._pointer} names {self.active}, but {self._path(self.active)} is not there: "
                f"restore that file, or remove {self._pointer.name} to start without a calibration"
            )

    @property
    def active(self) -> str | None:
        """The id of the promoted calibration."""
        return self._history[-1]["calibration_id"] if self._history else None

    def ids(self) -> list[str]:
        return sorted(path.stem for path in self._directory.glob("*.json"))

    def add(self, calibration_id: str, content: dict[str, Any]) -> None:
        """Store a calibration for good. Storing the same content again does nothing.

        Raises BadInput when another calibration has this id.
        """
        path = self._path(calibration_id)
        if not path.exists():
            write_document(path, FILE, content)
            path.chmod(0o444)
        elif read_document(path, FILE)["calibration"] != content["calibration"]:
            raise BadInput(f"{path} exists already; calibrations are never overwritten")

    def info(self, calibration_id: str) -> CalibrationInfo:
        """One calibration; `active` stands for the promoted one."""
        wanted = self.active if calibration_id == "active" else calibration_id
        if wanted is None:
            raise NotFound("no calibration has been promoted yet", known=self.ids())
        document = self._read(wanted)
        return CalibrationInfo(
            calibration_id=wanted, active=wanted == self.active, document=document
        )

    def promote(self, calibration_id: str, client: str, *, despite_failed_verdict: bool) -> None:
        """Make a calibration the active one. BadInput when its verdict is not a pass, unless
        `despite_failed_verdict`. Promoting the active one again does nothing."""
        verdict = self._read(calibration_id)["verdict"]
        if verdict != "pass" and not despite_failed_verdict:
            raise BadInput(
                f"{calibration_id} failed its verdict and was not promoted; if you know better, "
                "promote it with despite_failed_verdict",
                verdict=verdict,
            )
        if calibration_id == self.active:
            return
        promotion = {
            "calibration_id": calibration_id,
            "promoted": utc_now(),
            "client": client,
            "verdict": verdict,
        }
        history = [*self._history, promotion]
        write_document(self._pointer, ACTIVE, {"active": calibration_id, "history": history})
        self._history = history

    def _read(self, calibration_id: str) -> dict[str, Any]:
        path = self._path(calibration_id)
        if not path.exists():
            known = self.ids()
            raise NotFound(
                f"no calibration {calibration_id!r}; there are: {', '.join(known) or 'none'}",
                known=known,
            )
        return read_document(path, FILE)

    def _path(self, calibration_id: str) -> Path:
        if not SAFE_ID.fullmatch(calibration_id):
            raise BadInput(f"{calibration_id!r} is not the id of a calibration")
        return self._directory / f"{calibration_id}.json"

    def _read_history(self) -> list[dict[str, Any]]:
        if not self._pointer.exists():
            return []
        document = read_document(self._pointer, ACTIVE)
        history = document.get("history")
        if not isinstance(history, list) or not all(map(_is_promotion, history)):
            raise BadInput(f"{self._pointer}: 'history' must list promotions with a calibration_id")
        newest = history[-1]["calibration_id"] if history else None
        if document.get("active") != newest:
            raise BadInput(
                f"{self._pointer}: 'active' is {document.get('active')!r}, but the newest "
                f"promotion in 'history' is of {newest!r}: restore the file, or make both the same"
            )
        return list(history)


def _is_promotion(item: Any) -> bool:
    return isinstance(item, dict) and isinstance(item.get("calibration_id"), str)
