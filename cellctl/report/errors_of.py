"""What each step leaves unexplained, point by point: the solvers keep the sums only, so it is
computed again from the recording and the result. All errors are (n, 2), seen minus predicted."""

from __future__ import annotations

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import Sheet
from cellctl.calib.patterns import marker_pictures
from cellctl.calib.projector_map import ProjectorMap
from cellctl.errors import BadInput
from cellctl.geometry import Array, invert, transform_points
from cellctl.report.odd import at, count, mapping, number, numbers, points, rows
from cellctl.report.recorded import Recorded
from cellctl.report.views import BoardView, board_views, camera_of, rigid, shown_markers, size_of

NONE = np.zeros((0, 2))


def intrinsic_errors(recorded: Recorded) -> Array:
    """Camera pixels: corners against the camera, each view in its own best pose."""
    part, camera = recorded.part("intrinsic"), camera_of(recorded)
    if camera is None or not at(part, "camera"):
        return NONE
    warp = np.array(numbers(part.get("board_warp_m"), 3) or [0.0, 0.0, 0.0])
    found = [_in_own_pose(view, camera, warp) for view in board_views(recorded, "intrinsic")]
    return finite(found)


def _in_own_pose(view: BoardView, camera: CameraModel, warp: Array) -> Array:
    """Solved for the flat board, for that is in closed form, then seen as the bent one."""
    bent = view.points.copy()
    bent[:, 2] += Sheet.of(view.points).lift(view.points) @ warp
    pose = BoardView(view.key, bent, view.pixels, None).pose(camera)
    if pose is None:
        return NONE
    return view.pixels - camera.project(transform_points(pose, bent))


def hand_eye_errors(recorded: Recorded) -> Array:
    """Camera pixels: the marker board against where the robot says that it is."""
    part, camera = recorded.part("hand-eye"), camera_of(recorded, "hand-eye")
    eye, board = rigid(part.get("T_base_camera")), rigid(part.get("T_flange_board"))
    if camera is None or eye is None or board is None:
        return NONE
    scale = number(at(part, "summary", "board_scale")) or 1.0
    found = []
    for view in board_views(recorded, "hand-eye"):
        if view.flange is not None:
            pose = invert(eye) @ view.flange @ board
            found.append(view.pixels - camera.project(transform_points(pose, scale * view.points)))
    return finite(found)


def projector_field(recorded: Recorded) -> tuple[Array, Array]:
    """Projector pixels: where markers were shown (n, 2), and how far from there the map puts what
    the camera saw of them (n, 2)."""
    part, camera = recorded.part("projector"), camera_of(recorded)
    used = at(part, "markers", "used")
    try:
        light = ProjectorMap.from_dict(part.get("projector"))
    except (BadInput, ValueError, TypeError):
        return NONE, NONE
    if camera is None or not isinstance(used, list):
        return NONE, NONE
    shown = shown_centres(recorded)
    seen = [
        (shown[n], centre)
        for _, found in shown_markers(recorded)
        for n, centre in found.items()
        if n in used and n in shown
    ]
    if not seen:
        return NONE, NONE
    places = np.array([place for place, _ in seen])
    errors = places - light.project(camera.normalise(np.array([centre for _, centre in seen])))
    known = np.isfinite(errors).all(axis=1)
    return places[known], errors[known]


def projector_errors(recorded: Recorded) -> Array:
    """Projector pixels: as `projector_field`, the errors alone."""
    return projector_field(recorded)[1]


def shown_centres(recorded: Recorded) -> dict[int, Array]:
    """Where the markers were in the projector's pictures; empty when that is not known."""
    params = recorded.params("projector")
    size = size_of(at(recorded.config, "projector", "size_px"))
    asked = [number(params.get(name)) for name in ("columns", "rows", "pictures")]
    if size is None or None in asked or max(size) > 16384:
        return {}
    columns, down, pictures = (int(value or 0) for value in asked)
    if not (0 < columns <= 50 and 0 < down <= 50 and 0 < pictures <= 16):
        return {}
    try:
        shown = marker_pictures(size, columns, down, pictures=pictures)
    except (BadInput, ValueError):
        return {}
    return {marker: centre for picture in shown for marker, centre in picture.centres.items()}


def evaluated_errors(recorded: Recorded) -> Array:
    """Millimetres: held-out circles."""
    circles = rows(recorded.part("evaluate"), "circles")
    return points([circle.get("error_mm") for circle in circles], 2)


def finite(found: list[Array]) -> Array:
    """All that are numbers, (n, 2)."""
    if not found:
        return NONE
    everything = np.concatenate(found)
    return np.asarray(everything[np.isfinite(everything).all(axis=1)])


def per_view(recorded: Recorded, part: str) -> list[tuple[str, float | None, float | None]]:
    """(view, training px, held-out px) as the solver has them."""
    names = {
        "intrinsic": ("per_view_px", "rms", "held_out"),
        "hand-eye": ("per_view", "rms_px", "held_out_px"),
    }
    where, training, held_out = names[part]
    listed = mapping(recorded.part(part), where)
    found = [(key, number(at(v, training)), number(at(v, held_out))) for key, v in listed.items()]
    return [row for row in sorted(found) if row[1] is not None or row[2] is not None]


def used_count(part: dict[str, object]) -> int | None:
    """How many views or markers a result rests on."""
    return count(at(part, "views", "used")) or count(at(part, "markers", "used"))
