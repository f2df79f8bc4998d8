"""Views of the boards as a run would plan them in a standard world, without its guard and paths."""

from __future__ import annotations

import numpy as np

from cellctl import ik
from cellctl.calib.camera import CameraModel
from cellctl.geometry import Array
from cellctl.procedures.choice import about_camera, spread_out
from cellctl.procedures.planning import Spread, candidates
from cellctl.procedures.rig import PlannedView, Rig
from cellctl.sim.truth import Rng, Truth

SPREADS = {
    ("cr", "checkerboard"): Spread(fill=(0.2, 0.5), spin_deg=25.0),
    ("cr", "markers"): Spread(fill=(0.2, 0.35), about_camera=True),
    ("ir", "checkerboard"): Spread(fill=(0.09, 0.16), spin_deg=25.0, middle=0.65),
    ("ir", "markers"): Spread(fill=(0.06, 0.11), middle=0.31),
}
"""What `planning.attainable` makes of the procedures' spreads: in the IR cell the arm cannot come
near to the camera."""
CANDIDATES, REACHED, CHOICE, STARTS = 16, 5, 3, 6
"""For each view that is wanted: candidates, those that are solved for the arm, and views to choose
from."""


def planned(truth: Truth, name: str, count: int, rng: Rng) -> list[Array]:
    """Joints (6,) of the nominal arm for about 2 `count` views of a board, spread out, the most
    extreme first."""
    rig = rig_of(truth, name)
    spread = SPREADS[truth.preset.name, name]
    poses = candidates(rig, spread, CANDIDATES * count, int(rng.integers(2**31)))
    flanges = rig.flange(poses)
    reached = truth.nominal_arm.may_reach(flanges[:, :3, 3])
    if truth.preset.fence is not None:
        reached &= flanges[:, 2, 3] < truth.preset.fence.high_m[2]
    poses = poses[reached][: REACHED * count]
    home = np.radians(truth.preset.home_deg)
    starts = np.vstack([home, ik.random_starts(truth.nominal_arm, STARTS, 0)])
    found = ik.solutions(truth.nominal_arm, rig.flange(poses), home, starts)
    views = [PlannedView(p, q[0]) for p, q in zip(poses, found, strict=True) if len(q)]
    chosen = spread_out(rig, views, CHOICE * count)
    if spread.about_camera:
        chosen = about_camera(chosen, count, truth.seed)
    return [view.joints for view in chosen[: 2 * count]]


def rig_of(truth: Truth, name: str) -> Rig:
    """As the search for the board finds it, to better than matters here."""
    lens, board = truth.camera.lens, truth.boards[name]
    vector = np.array([*lens.focal, *lens.centre, *lens.distortion])
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return Rig(
        camera=CameraModel.from_vector(vector, lens.size),
        T_world_camera=truth.camera.pose.matrix,
        T_flange_board=board.pose.matrix,
        outline=board.centre + board.half * corners,
    )
