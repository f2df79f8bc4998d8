"""What a refinement says about itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.refine_fit import Fit, Marks
from cellctl.calib.refinement import Refinement
from cellctl.calib.views import Rejection, rms
from cellctl.geometry import Array, Mask


@dataclass(frozen=True)
class Errors:
    """A root mean square in projector px and in mm on the table."""

    px: float
    mm: float

    def to_dict(self) -> dict[str, float]:
        return {"px": self.px, "mm": self.mm}


@dataclass(frozen=True, eq=False)
class Candidate:
    """How one family does. `refused` says why it was not tried, else it is empty.

    `errors` by name: "training"; "leave_one_out", "leave_row_out" of the circles used; and the
    same two with those rejected, "..._all". `held_out_mm` (n, ways, 2) are the errors of the
    circles used in the worse of the two ways, `left_one_out_mm` those in the first.
    """

    name: str
    condition: float
    refused: str = ""
    fit: Fit | None = None
    errors: Mapping[str, Errors] = field(default_factory=dict)
    held_out_mm: Any = ()
    left_one_out_mm: Any = ()

    @property
    def worse_mm(self) -> float:
        return rms(self.held_out_mm)

    @classmethod
    def measured(
        cls,
        name: str,
        condition: float,
        fit: Fit,
        held_out: Mapping[str, Array],
        marks: Marks,
        used: Mask,
        base: Calibration,
    ) -> Candidate:
        """`held_out` are predicted camera coordinates (n, 2, ways) without the circle ("one")
        and without its row or column ("row")."""
        one, row = (_both(marks, base, held_out[key]) for key in ("one", "row"))
        training = _both(marks, base, fit.predict(marks)[..., None])
        errors = {
            "training": _errors(training, used),
            "leave_one_out": _errors(one, used),
            "leave_row_out": _errors(row, used),
            "leave_one_out_all": _errors(one, np.ones_like(used)),
            "leave_row_out_all": _errors(row, np.ones_like(used)),
        }
        worse = max((one, row), key=lambda both: _errors(both, used).mm)
        apart = _by_circle(worse[1][used]), _by_circle(one[1][used])
        return cls(name, condition, "", fit, errors, *apart)

    def to_dict(self) -> dict[str, Any]:
        return {
            "allowed": not self.refused,
            "why_not": self.refused or None,
            "condition": self.condition if np.isfinite(self.condition) else None,
            "errors": {name: errors.to_dict() for name, errors in self.errors.items()},
        }


def _both(marks: Marks, base: Calibration, predicted: Array) -> tuple[Array, Array]:
    """Errors (n, ways, 2) in projector px and in mm of predicted camera coordinates."""
    each = np.moveaxis(predicted, 2, 0)
    seen_px, seen_mm = base.projector.project(marks.seen), marks.on_table_mm(marks.seen)
    px = [base.projector.project(xy) - seen_px for xy in each]
    mm = [marks.on_table_mm(xy) - seen_mm for xy in each]
    return np.stack(px, axis=1), np.stack(mm, axis=1)


def _errors(both: tuple[Array, Array], used: Mask) -> Errors:
    return Errors(rms(both[0][used]), rms(both[1][used]))


def _by_circle(errors: Array) -> Array:
    """(n, ways, 2), each circle's mean square kept whatever the number of ways."""
    return errors / np.sqrt(errors.shape[1])


@dataclass(frozen=True, eq=False)
class RefineResult:
    """`tcp_mm` (2,): how far the pen stands from where its tip is believed, in world axes at the
    drawing posture, with its covariance. `errors_mm` (n, 2) and `errors_px` are the fit's errors
    of all circles, predicted minus seen, on the table and in the projector; `used` (n,) those
    that it rests on. `mark_sigma_mm`: noise of a mark per axis, known with `mark_freedom` degrees
    of freedom."""

    refinement: Refinement
    tcp_mm: Array
    tcp_covariance_mm2: Array
    chosen: str
    why: str
    candidates: tuple[Candidate, ...]
    keys: tuple[str, ...]
    errors_mm: Array
    errors_px: Array
    used: Mask
    rejected: tuple[Rejection, ...]
    mark_sigma_mm: float
    mark_freedom: float

    def candidate(self, name: str) -> Candidate:
        return next(c for c in self.candidates if c.name == name)

    @property
    def errors(self) -> Mapping[str, Errors]:
        """Of the chosen family, see `Candidate.errors`."""
        return self.candidate(self.chosen).errors

    def to_dict(self) -> dict[str, Any]:
        return {
            "chosen": self.chosen,
            "why": self.why,
            "candidates": {c.name: c.to_dict() for c in self.candidates},
            "errors": {name: errors.to_dict() for name, errors in self.errors.items()},
            "tcp_mm": self.tcp_mm.tolist(),
            "tcp_sigma_mm": np.sqrt(self.tcp_covariance_mm2.diagonal()).tolist(),
            "tcp_covariance_mm2": self.tcp_covariance_mm2.tolist(),
            "mark_sigma_mm": self.mark_sigma_mm,
            "mark_freedom": self.mark_freedom,
            "circles": {
                "used": [k for k, ok in zip(self.keys, self.used, strict=True) if ok],
                "rejected": [r.to_dict() for r in self.rejected],
            },
            "per_circle": {
                key: {"px": px.tolist(), "mm": mm.tolist()}
                for key, px, mm in zip(self.keys, self.errors_px, self.errors_mm, strict=True)
            },
            "refinement": self.refinement.to_dict(),
        }
