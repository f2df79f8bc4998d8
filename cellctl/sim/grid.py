"""The points at which a run is scored, and the joints at which the pen would stand on them."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from cellctl import ik
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array
from cellctl.sim.presets import Preset
from cellctl.sim.truth import STREAMS, Truth, score, scoring_grid

STARTS = 48


def touched_height(truth: Truth) -> float:
    """The table's height in the world frame, metres, as the robot knows it from touching: that
    of the surface over the drawn area, off by the preset's amount with a sign of the seed's."""
    preset = truth.preset
    half = np.array(preset.table.area_m) / 2
    steps = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 2), axis=-1).reshape(-1, 2) * half
    above = np.column_stack([steps + preset.table.centre_m[:2], np.full(len(steps), 10.0)])
    down = np.array([0.0, 0.0, -1.0])
    surface = np.array([truth.table.hit(point, down[None])[0, 2] for point in above]).mean()
    rng = np.random.default_rng([truth.seed, STREAMS.index("touch")])
    return float(surface + preset.table.touched_height_off_m * rng.choice((-1.0, 1.0)))


class Grid:
    """The scoring grid of one cell, at the height that the robot knows."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self.height = touched_height(truth)
        self._xy = scoring_grid(truth.preset)

    @property
    def points(self) -> Array:
        """World points (121, 3)."""
        return np.column_stack([self._xy, np.full(len(self._xy), self.height)])

    @cached_property
    def joints(self) -> Array:
        """Joints (121, 6) at which the nominal arm draws at the points, all of one branch."""
        return drawing_joints(self._truth, self._xy, self.height)

    def score(self, pixels: Array, truth: Truth) -> dict[str, Any]:
        """`true_mm` and `true_px` of projector `pixels` (121, 2), in the cell as it is now."""
        if pixels.shape != (len(self._xy), 2):
            raise BadInput(f"{len(self._xy)} pixels (x, y) are scored, not an array {pixels.shape}")
        return score(truth, self._xy, self.joints, pixels)


def drawing_joints(truth: Truth, xy: Array, height: float) -> Array:
    """Joints (n, 6) of the nominal arm in its drawing posture at (x, y, height).

    The branch is the one nearest to the home posture at the middle of the area; neighbouring
    points follow it. SolveError when a point is out of reach.
    """
    model, preset = truth.nominal_arm, truth.preset
    middle = np.array([preset.table.centre_m[:2]])
    home = np.radians(preset.home_deg)
    starts = ik.random_starts(model, STARTS, seed=0)
    found = ik.solutions(model, truth.drawing_pose(middle, height), home, starts)[0]
    for branch in found:
        joints, converged = ik.refine(
            model, truth.drawing_pose(xy, height), np.tile(branch, (len(xy), 1))
        )
        if (converged & model.within_limits(joints)).all():
            return joints
    raise SolveError(f"the drawn area of preset {preset.name!r} is out of the pen's reach")


def describe(preset: Preset) -> dict[str, Any]:
    """What anybody may know of a cell: its arm and its image sizes."""
    return {
        "preset": preset.name,
        "arm": preset.arm,
        "camera_px": list(preset.camera.size_px),
        "projector_px": list(preset.projector.size_px),
    }
