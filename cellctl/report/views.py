"""The geometry of what was recorded: views of boards, the camera they were seen with, markers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.pose import board_pose
from cellctl.calib.views import View
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array, Transform
from cellctl.report.odd import at, mapping, number, numbers, points
from cellctl.report.recorded import Recorded, good
from cellctl.store.history import Sample

MARKER = re.compile(r"\d{1,6}")


@dataclass(frozen=True, eq=False)
class BoardView:
    """A view of a board: `points` (n, 3) on it in metres and their `pixels` (n, 2); the pose of
    the flange (4, 4) in the robot's frame if it is known."""

    key: str
    points: Array
    pixels: Array
    flange: Array | None

    def pose(self, camera: CameraModel) -> Array | None:
        """T_camera_board (4, 4) by this picture alone; None when it does not fix one."""
        try:
            pose = board_pose(View(self.key, self.points, self.pixels), camera).matrix
        except (SolveError, BadInput, ValueError, ArithmeticError, np.linalg.LinAlgError):
            return None
        return pose if np.isfinite(pose).all() else None


def board_views(recorded: Recorded, part: str) -> list[BoardView]:
    """The views that a part's result rests on; without a result, all good ones."""
    used = at(recorded.part(part), "views", "used")
    samples = good(recorded.samples(part, "views"), used if isinstance(used, list) else None)
    found = (_view(key, sample) for key, sample in sorted(samples.items()))
    return [view for view in found if view is not None]


def _view(key: str, sample: Sample) -> BoardView | None:
    """None for a sample that shows no board."""
    pixels, places = points(at(sample.data, "pixels"), 2), points(at(sample.data, "points"), 3)
    if len(pixels) != len(places) or len(pixels) < 4:
        return None
    return BoardView(key, places, pixels, rigid(at(sample.data, "T_world_flange")))


def rigid(value: Any) -> Array | None:
    """A pose (4, 4), or None."""
    try:
        return Transform("a", "b", value).matrix if value is not None else None
    except (BadInput, TypeError, ValueError):
        return None


def camera_of(recorded: Recorded, part: str = "intrinsic") -> CameraModel | None:
    """The camera that the run came to, else the maker's."""
    for solved in (recorded.part(part), recorded.part("intrinsic"), recorded.calibration):
        if (camera := _camera(at(solved, "camera"))) is not None:
            return camera
    factory = mapping(recorded.config, "camera", "factory")
    focal, centre = numbers(factory.get("focal_px"), 2), numbers(factory.get("centre_px"), 2)
    size = picture_size(recorded)
    if focal is None or centre is None or size is None:
        return None
    K = [[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]]
    try:
        return CameraModel(np.array(K), np.array(factory.get("distortion"), dtype=float), size)
    except (BadInput, TypeError, ValueError):
        return None


def _camera(value: Any) -> CameraModel | None:
    try:
        return CameraModel.from_dict(value, "camera") if isinstance(value, dict) else None
    except (BadInput, KeyError, TypeError, ValueError, AttributeError):
        return None


def picture_size(recorded: Recorded) -> tuple[int, int] | None:
    """Width and height of the camera's pictures."""
    return size_of(at(recorded.config, "camera", "image_size_px")) or size_of(
        at(recorded.part("intrinsic"), "camera", "image_size")
    )


def size_of(value: Any) -> tuple[int, int] | None:
    """(w, h) in pixels that a picture may have."""
    found = numbers(value, 2)
    if found is None or not all(1 <= side <= 65536 for side in found):
        return None
    return int(found[0]), int(found[1])


def shown_markers(recorded: Recorded) -> list[tuple[str, dict[int, Array]]]:
    """By picture, the centres {id: (2,)} of the projected markers in camera pixels."""
    samples = recorded.samples("projector", "pictures")
    return [(key, _markers(sample)) for key, sample in sorted(samples.items())]


def _markers(sample: Sample) -> dict[int, Array]:
    found: dict[int, Array] = {}
    for name, value in mapping(sample.data, "markers").items():
        centre = numbers(value, 2)
        if centre is not None and MARKER.fullmatch(name, endpos=6):
            found[int(name)] = np.array(centre)
    return found


@dataclass(frozen=True)
class Circle:
    """A drawn circle as `draw` or `evaluate` tells of it; metres in the world, camera pixels."""

    key: str
    x: float | None
    y: float | None
    centre: list[float] | None
    state: str
    round: int | None
    picture: str


def drawn_circles(recorded: Recorded) -> list[Circle]:
    """All circles of the run."""
    return [
        Circle(
            key=str(row.get("key", "")),
            x=number(row.get("x")),
            y=number(row.get("y")),
            centre=numbers(row.get("centre_px"), 2),
            state=str(row.get("state", "good")),
            round=None if number(row.get("round")) is None else int(number(row["round"]) or 0),
            picture=str(row.get("picture") or ""),
        )
        for row in mapping_rows(recorded)
    ]


def mapping_rows(recorded: Recorded) -> list[dict[str, Any]]:
    circles = recorded.part("draw").get("circles")
    return [row for row in circles if isinstance(row, dict)] if isinstance(circles, list) else []


def held_out_keys(recorded: Recorded) -> set[str]:
    """The circles that no fit has seen."""
    circles = recorded.part("evaluate").get("circles")
    listed = circles if isinstance(circles, list) else []
    return {str(row.get("key", "")) for row in listed if isinstance(row, dict)}
