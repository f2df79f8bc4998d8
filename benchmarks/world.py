"""A standard world without pictures, and what a whole run would record in it.

True geometry with Gaussian noise of corners, markers, touches and circles. `solved` hands these
records, and nothing of the truth, to the solvers that a run hands them to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.published import Data
from benchmarks.views import planned
from cellctl.calib.calibration import Calibration
from cellctl.calib.hand_eye import solve_hand_eye
from cellctl.calib.intrinsic import solve_intrinsic
from cellctl.calib.joint.observations import BoardViews, Circles, Lit, Observations
from cellctl.calib.joint.result import JointResult
from cellctl.calib.joint.solve import solve_joint
from cellctl.calib.projector import LensPrior, solve_projector
from cellctl.calib.refine_fit import Mark
from cellctl.calib.table import solve_table
from cellctl.calib.table_surface import Area
from cellctl.geometry import Array
from cellctl.sim.presets import PRESETS, Preset
from tests.calib.drawn import DrawnCell, layout
from tests.calib.numeric_cell import NumericCell, numeric_cell

PLANTS = ("kinematics", "bow", "draw-noise")
TOUCHES, SPOTS, ROUNDS = 12, 12, 5


def planted(preset: Preset, plant: str | None) -> Preset:
    """The preset with one thing worse: kinematic error x3, bow 2 mm, draw noise 0.5 mm per axis."""
    if plant == "kinematics":
        errors = preset.arm_errors
        worse = replace(
            errors,
            zero_sigma_deg=3 * errors.zero_sigma_deg,
            length_sigma_m=3 * errors.length_sigma_m,
            twist_sigma_deg=3 * errors.twist_sigma_deg,
        )
        return replace(preset, arm_errors=worse)
    if plant == "bow":
        return replace(preset, table=replace(preset.table, bow_m=2.0e-3))
    if plant == "draw-noise":
        return replace(preset, pen_slip_sigma_m=0.5e-3)
    return preset


@dataclass(frozen=True, eq=False)
class World:
    """`seen`: boards and projected markers; `drawing`: the pen, and who scores; `touched` (n, 3) of
    the table. `rng` makes the noise of what is drawn and touched."""

    seen: NumericCell
    drawing: DrawnCell
    touched: Array
    rng: np.random.Generator

    def circles(self, xy: Array, yaws: Array | None = None) -> list[Mark]:
        """Drawn at xy (n, 2), seen by the solved camera."""
        return self.drawing.marks(xy, self.rng, yaws)

    def adjust(self, marks: Sequence[Mark]) -> JointResult:
        """Everything that was seen, adjusted together."""
        seen, base = self.seen, self.drawing.base
        light = [(seen.centres[i], place) for p in seen.pictures for i, place in p.items()]
        observations = Observations(
            views=[
                BoardViews("intrinsic views", "checkerboard", seen.intrinsic),
                BoardViews("hand-eye views", "markers", seen.hand_eye),
            ],
            touches=self.touched,
            markers=Lit(np.array([p for p, _ in light]), np.array([c for _, c in light])),
            circles=Circles.of(marks, base.camera),
        )
        return solve_joint(observations, base)

    def pictured(self, xy: Array) -> Array:
        """Camera pixels (n, 2) of circles drawn at xy (n, 2) in the drawing posture."""
        upright = self.circles(xy, np.zeros(len(xy)))
        rays = np.column_stack([[mark.seen for mark in upright], np.ones(len(xy))])
        return self.drawing.base.camera.project(rays)

    def spots(self, rounds: int, repeats: int) -> Array:
        """Places (12 rounds repeats, 2) for circles: `rounds` times 12 spots, each `repeats` times
        drawn at."""
        return np.tile(layout(self.seen.truth, self.rng, rounds), (repeats, 1))

    def data(self) -> Data:
        """What the published pipeline starts from."""
        seen = self.seen
        return Data(
            checkerboard=seen.intrinsic,
            markers=seen.hand_eye,
            seen={i: pixel for picture in seen.pictures for i, pixel in picture.items()},
            sent=seen.centres,
            factory=seen.factory,
            height=seen.table_height,
        )


def world(cell: str, seed: int, plant: str | None = None) -> World:
    """A cell of that seed, its boards and markers seen and solved, its table touched."""
    seen = numeric_cell(seed, preset=planted(PRESETS[cell], plant), poser=planned)
    rng = np.random.default_rng([seed, 55])
    touched = touches(seen, rng)
    base = solved(seen, touched)
    return World(seen, DrawnCell(seen.truth, base, seen.known), touched, rng)


def solved(seen: NumericCell, touched: Array) -> Calibration:
    """By the product's solvers, one after the other, as a full run does before it draws."""
    preset = seen.truth.preset  # what the config says: data sheet and area
    camera = solve_intrinsic(seen.intrinsic, seen.factory.image_size).camera
    pose = solve_hand_eye(seen.hand_eye, "eye-to-hand", camera=camera)
    lens = LensPrior(
        preset.projector.throw_ratio * preset.projector.size_px[0],
        np.array(preset.projector.centre_px),
    )
    projector = solve_projector(seen.pictures, seen.centres, camera, lens=lens)
    middle, half = np.array(preset.table.centre_m[:2]), np.array(preset.table.area_m) / 2
    surface = solve_table(touched, area=Area(middle - half, middle + half))
    quality = {"hand_eye_covariance": pose.covariance.tolist()}
    base = Calibration(camera, pose.camera_pose, surface.plane, projector.map, quality=quality)
    return base.on(surface)


def touches(seen: NumericCell, rng: np.random.Generator) -> Array:
    """Where the controller reports the pen's tip (n, 3) when it is felt to touch."""
    truth, known = seen.truth, seen.known
    xy = layout(truth, rng, rounds=1)
    idle = DrawnCell(truth, None, known)  # type: ignore[arg-type] # nothing is solved yet
    joints = idle.joints(xy, np.zeros(len(xy)))
    flange = truth.arm.forward(joints)
    tips = flange[:, :3, :3] @ truth.pen + flange[:, :3, 3]
    below = ((truth.pen_lands(xy, joints) - tips) * flange[:, :3, 2]).sum(axis=1)
    pen, repeat = truth.preset.pen, truth.preset.arm_errors.repeat_sigma_m
    pushed = rng.normal(pen.felt_m, np.hypot(pen.felt_sigma_m, repeat), len(xy))
    return np.column_stack([xy, known.height - below - pushed])
