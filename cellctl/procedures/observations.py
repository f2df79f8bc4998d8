"""From samples on disk to what the solvers work on, the same way online and offline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.printed import Unseen
from cellctl.calib.targets import Board, Detection
from cellctl.calib.views import Rejection, RobotView
from cellctl.drivers.base import Image
from cellctl.errors import BadInput
from cellctl.geometry import Array, Transform
from cellctl.procedures.record import Record
from cellctl.store.history import Sample


@dataclass(frozen=True, eq=False)
class Collected:
    """Good views of a board, and the samples that were not good. A view must have
    `minimum_points` to count."""

    views: list[RobotView]
    bad: list[Rejection]
    image_size: tuple[int, int]
    minimum_points: int

    def merged(self, solved: dict[str, Any]) -> dict[str, Any]:
        """A solver's JSON, with the samples that never reached the solver among the rejected."""
        views = solved["views"]
        rejected = [*views["rejected"], *(rejection.to_dict() for rejection in self.bad)]
        return {**solved, "views": {**views, "rejected": rejected}}


def observation(detection: Detection | None) -> dict[str, Any]:
    """The JSON form of a detection."""
    if detection is None:
        return {"ids": [], "pixels": [], "points": []}
    return {
        "ids": detection.ids.tolist(),
        "pixels": detection.pixels.tolist(),
        "points": detection.points.tolist(),
    }


def collected(record: Record[Any], step: str, board: Board) -> Collected:
    """The views of a sweep's samples. BadInput names a sample whose data are not a view."""
    views, bad = [], []
    for key, sample in sorted(record.samples(step).items()):
        if flaw := sample.data.get("flaw"):
            bad.append(Rejection(key, flaw))
            continue
        view = _seen_again(sample, board) if record.again else journalled(sample, board)
        if isinstance(view, Unseen):
            bad.append(Rejection(key, view.reason))
        else:
            views.append(view)
    return Collected(views, bad, record.config.camera.image_size_px, board.minimum_points)


def journalled(sample: Sample, board: Board) -> RobotView | Unseen:
    """The view as it was detected when the sample was taken."""
    data = sample.data
    if not data["ids"]:
        return Unseen(data["flaw"])
    return _view(sample, board, np.array(data["points"]), np.array(data["pixels"]))


def _seen_again(sample: Sample, board: Board) -> RobotView | Unseen:
    """The view as it is detected now in the picture on disk."""
    found = board.look(picture(sample))
    if isinstance(found, Unseen):
        return found
    return _view(sample, board, found.points, found.pixels)


def picture(sample: Sample) -> Image:
    """A sample's picture from disk; BadInput when it is missing or not what was written."""
    return sample.images["image"].load()


def _view(sample: Sample, board: Board, points: Array, pixels: Array) -> RobotView:
    try:
        pose = Transform("world", "flange", sample.data["T_world_flange"])
    except (KeyError, BadInput) as error:
        raise BadInput(f"sample {sample.key}: T_world_flange: {error}") from None
    return RobotView(sample.key, points, pixels, pose, board.symmetries)
