"""What was drawn, what of it was found, and what went wrong with pen and paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib import marks
from cellctl.calib.calibration import Calibration
from cellctl.calib.camera import CameraModel
from cellctl.calib.compare import placed
from cellctl.calib.refine_fit import Mark
from cellctl.geometry import Array
from cellctl.procedures.observations import picture
from cellctl.procedures.pictures import BLANK, PICTURES, Circle, Found, Search, find_drawn
from cellctl.procedures.record import Record, Samples
from cellctl.store.history import Sample

DRY_SHARE = 0.5
"""Of the newest circles; with more unseen the pen is dry, or draws beside the paper."""
DRY_TAIL = 0.9
"""Of the circles from the first that is missing on: the ink has run out."""
LOST_SHARE = 0.1
"""Of all circles that may be missing before the drawing fails."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """All circles of a drawing, the void ones with the reason, and what each picture shows, oldest
    first, by its name."""

    circles: list[Circle]
    void: dict[str, str]
    pictures: dict[str, Found]

    @property
    def found(self) -> Found:
        """Of each circle what the first picture after it shows."""
        found: Found = {}
        for shown in self.pictures.values():
            for key, item in shown.items():
                found.setdefault(key, item)
        return found

    @property
    def lost(self) -> dict[str, str]:
        """Why a circle that was drawn was not found."""
        return {key: item["unseen"] for key, item in self.found.items() if "unseen" in item}

    def good(self) -> list[Circle]:
        """The circles that were found."""
        return [c for c in self.circles if "centre_px" in self.found.get(c.key, {})]

    def marks(self, camera: CameraModel) -> list[Mark]:
        """As the solvers take them."""
        return marks_of(self.good(), self.found, camera)

    def to_dict(self) -> dict[str, Any]:
        lost = [{"id": key, "reason": reason} for key, reason in self.lost.items()]
        void = [{"id": key, "reason": reason} for key, reason in self.void.items()]
        found = self.found
        told = [_circle_data(circle, found.get(circle.key, {})) for circle in self.circles]
        return {"circles": told, "rejected": lost, "void": void}


def _circle_data(circle: Circle, found: Mapping[str, Any]) -> dict[str, Any]:
    x, y = circle.measured
    return {
        "key": circle.key,
        "round": circle.round,
        "yaw_deg": round(float(np.degrees(circle.yaw)), 3),
        "x": float(x),
        "y": float(y),
        "radius_m": circle.radius,
        "state": "good" if "centre_px" in found else "lost",
        "centre_px": found.get("centre_px"),
        "found_radius_m": found.get("radius_m"),
        "seen": found.get("seen"),
    }


def marks_of(circles: Sequence[Circle], found: Found, camera: CameraModel) -> list[Mark]:
    """Circles that were found, as the solvers take them."""
    pixels = np.array([found[c.key]["centre_px"] for c in circles]).reshape(-1, 2)
    return [
        Mark(key=c.key, xy=c.measured, yaw=c.yaw, seen=xy, round=c.round + 1)
        for c, xy in zip(circles, camera.normalise(pixels), strict=True)
    ]


def circles(samples: Samples) -> list[Circle]:
    """Those that were drawn to their end, in the order in which they were drawn."""
    return _circles({key: sample.data for key, sample in samples.items()})


def _circles(journalled: Mapping[str, Mapping[str, Any]]) -> list[Circle]:
    every = sorted(journalled.items())
    return [_circle(key, data) for key, data in every if data["state"] == "drawn"]


def _circle(key: str, data: Mapping[str, Any]) -> Circle:
    return Circle(
        key=key,
        round=data["round"],
        sheet=data["sheet"],
        xy=np.array(data["xy"]),
        measured=np.array(data["measured"]["xy"]),
        yaw=data["yaw"],
        radius=data["radius_m"],
    )


def of_journal(
    circles: Mapping[str, Mapping[str, Any]], pictures: Mapping[str, Mapping[str, Any]]
) -> Drawn:
    """From the journalled data of the circles' and of the pictures' samples."""
    void = {k: d["flaw"] for k, d in sorted(circles.items()) if d["state"] == "void"}
    shown = {k: d["found"] for k, d in sorted(pictures.items()) if "found" in d}
    return Drawn(_circles(circles), void, shown)


def seen(record: Record[Any], step: str, base: Calibration, search_m: float) -> Drawn:
    """From the journal; `record.again`: found anew in the pictures on disk."""
    samples = record.samples(step)
    pictures = record.samples(PICTURES)
    every = circles(samples)
    void = {k: s.data["flaw"] for k, s in sorted(samples.items()) if s.data["state"] == "void"}
    shown = {
        key: _again(record, base, sample, every, search_m) if record.again else sample.data["found"]
        for key, sample in sorted(pictures.items())
        if "found" in sample.data
    }
    return Drawn(every, void, shown)


def _again(
    record: Record[Any], base: Calibration, sample: Sample, every: Sequence[Circle], search_m: float
) -> Found:
    search = Search(base, search_m, record.config.bracket.pen.line_m)
    there = [circle for circle in every if circle.key in sample.data["found"]]
    before = picture(record.samples(PICTURES)[BLANK])
    return find_drawn(picture(sample), before, search, there)


def trouble(drawn: Drawn, number: int, base: Calibration) -> str:
    """Why it is no use to draw on after the round `number`; empty when it is."""
    newest = [drawn.found.get(c.key, {}) for c in drawn.circles if c.round == number]
    lost = [item for item in newest if "unseen" in item]
    if len(lost) > DRY_SHARE * len(newest):
        return f"{len(lost)} of {len(newest)} circles of round {number + 1} are not there"
    return "; ".join(_moved(drawn, base))


def faults(drawn: Drawn, base: Calibration) -> list[str]:
    """What went wrong with pen and paper, in words; empty when nothing did."""
    return [*_missing(drawn), *_moved(drawn, base), *_sized(drawn)]


def _missing(drawn: Drawn) -> list[str]:
    lost, order = drawn.lost, [c.key for c in drawn.circles if c.key in drawn.found]
    if len(lost) <= LOST_SHARE * len(order):
        return []
    first = next(i for i, key in enumerate(order) if key in lost)
    tail = order[first:]
    if len(lost) > DRY_TAIL * len(tail):
        dry = (
            f"from {order[first]} on, {len(lost)} of {len(tail)} circles left no ink or too little"
        )
        return [f"the pen is dry: {dry} ({lost[order[first]]}): put in another one"]
    return [
        f"{len(lost)} of {len(order)} circles were not found; {order[first]}: {lost[order[first]]}"
    ]


def _moved(drawn: Drawn, base: Calibration) -> list[str]:
    """Circles that are seen again somewhere else."""
    pictures = [(name, _places(found, base)) for name, found in drawn.pictures.items()]
    sheets = {circle.key: circle.sheet for circle in drawn.circles}
    return [motion.reason for motion in marks.sheet_motions(pictures, sheets)]


def _places(found: Found, base: Calibration) -> dict[str, Array]:
    """World places (2,) of the circles in a picture."""
    there = {key: item["centre_px"] for key, item in found.items() if "centre_px" in item}
    if not there:
        return {}
    world = placed(base, base.camera.normalise(np.array(list(there.values()))))
    return dict(zip(there, world, strict=True))


def _sized(drawn: Drawn) -> tuple[str, ...]:
    """Circles that are smaller or larger than was commanded."""
    good = drawn.good()
    sizes = marks.radii(
        [1e3 * drawn.found[circle.key]["radius_m"] for circle in good],
        [1e3 * circle.radius for circle in good],
    )
    return sizes.reasons if sizes else ()
