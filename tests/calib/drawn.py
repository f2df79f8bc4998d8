"""Circles that the simulated cell's true arm draws, without pictures: truth plus Gaussian noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cellctl import ik
from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.camera import CameraModel
from cellctl.calib.hand_eye import solve_hand_eye
from cellctl.calib.intrinsic import solve_intrinsic
from cellctl.calib.patterns import marker_pictures
from cellctl.calib.projector import LensPrior, solve_projector
from cellctl.calib.refine_fit import Mark
from cellctl.geometry import Array, Transform, pose_matrix
from cellctl.sim.grid import Grid, drawing_joints
from cellctl.sim.presets import PRESETS, Preset
from cellctl.sim.truth import Truth, draw
from tests.calib.numeric_cell import numeric_cell

REPEAT_MM, DETECTION_PX = 0.07, 0.03
MARKER_PX = 0.035
YAWS = np.radians([0.0, 60.0, -60.0])
SPOTS = (4, 3)


@dataclass(frozen=True, eq=False)
class DrawnCell:
    truth: Truth
    base: Calibration
    grid: Grid

    def score(self, calibration: Calibration) -> float:
        """true_mm over 110 % of the drawn area."""
        light = self.truth.light_lands(calibration.project(self.grid.points))
        gap = np.linalg.norm((light - self.pen)[:, :2], axis=1)
        return 1e3 * float(np.sqrt(np.mean(gap**2)))

    @cached_property
    def pen(self) -> Array:
        """Where the pen stands (121, 3) on the scored grid; for many scores of one cell."""
        return self.truth.pen_lands(self.grid.points[:, :2], self.grid.joints)

    @cached_property
    def home(self) -> Array:
        """Joints (6,) of the drawing posture at the middle of the area."""
        middle = np.array([self.truth.preset.table.centre_m[:2]])
        return drawing_joints(self.truth, middle, self.grid.height)[0]

    def joints(self, xy: Array, yaws: Array) -> Array:
        """Joints (n, 6) of the nominal arm drawing at xy (n, 2) with the tool turned by yaws."""
        poses = np.concatenate(
            [
                self.truth.drawing_pose(place[None], self.grid.height, yaw)
                for place, yaw in zip(xy, yaws, strict=True)
            ]
        )
        starts = self.home + np.outer(-yaws, np.eye(6)[5])
        joints, converged = ik.refine(self.truth.nominal_arm, poses, starts)
        assert converged.all()
        return joints

    def marks(
        self, xy: Array, rng: np.random.Generator, yaws: Array | None = None, noise: float = 1.0
    ) -> list[Mark]:
        """Circles drawn at xy (n, 2), in rounds of 12, the yaw changing from one to the next."""
        yaws = YAWS[np.arange(len(xy)) % 3] if yaws is None else yaws
        pen = self.truth.pen_lands(xy, self.joints(xy, yaws))
        sigma = noise * np.hypot(self.truth.preset.pen_slip_sigma_m, 1e-3 * REPEAT_MM)
        pen[:, :2] += rng.normal(0.0, sigma, (len(xy), 2))
        return self.seen(xy, yaws, pen, rng, noise)

    def seen(
        self, xy: Array, yaws: Array, pen: Array, rng: np.random.Generator, noise: float = 1.0
    ) -> list[Mark]:
        """Circles whose centres lie at the world points `pen` (n, 3)."""
        pixels = self.truth.camera.project(pen) + rng.normal(
            0.0, noise * DETECTION_PX, (len(xy), 2)
        )
        centres = self.base.camera.normalise(pixels)
        return [
            Mark(f"circle-{i:03d}", xy[i], float(yaws[i]), centres[i], 1 + i // 12)
            for i in range(len(xy))
        ]


def layout(truth: Truth, rng: np.random.Generator, rounds: int = 5, jitter: float = 0.35) -> Array:
    """World places (12 rounds, 2): a 4 x 3 grid over the drawn area, jittered by a part of its
    pitch, rows along x."""
    half = np.array(truth.preset.table.area_m) / 2
    steps = np.stack(
        np.meshgrid(np.linspace(-1, 1, SPOTS[0]), np.linspace(-1, 1, SPOTS[1])), axis=-1
    ).reshape(-1, 2)
    pitch = 2.0 / (np.array(SPOTS) - 1)
    moves = rng.uniform(-jitter, jitter, (rounds, len(steps), 2)) * pitch
    places = np.clip(steps + moves, -1.0, 1.0).reshape(-1, 2)
    return truth.preset.table.centre_m[:2] + places * half


def quick_cell(seed: int, preset: str | Preset = "cr") -> DrawnCell:
    """A cell whose base calibration is off as a solved one is, but was not solved: camera and
    hand-eye perturbed from the truth, the projector map from noisy markers."""
    truth = draw(PRESETS[preset] if isinstance(preset, str) else preset, seed)
    rng = np.random.default_rng([seed, 55])
    lens = truth.camera.lens
    scale = lens.size[0] / 1920
    vector = np.array([*lens.focal, *lens.centre, *lens.distortion])
    vector[:4] += rng.normal(0.0, 0.3 * scale, 4)
    vector[4:] += rng.normal(0.0, (3e-4, 6e-4, 5e-5, 5e-5, 4e-4))
    camera = CameraModel.from_vector(vector, lens.size)
    turn = rng.normal(0.0, np.radians(0.03), 3)
    off = pose_matrix(turn, rng.normal(0.0, (5e-4, 5e-4, 1e-3)))
    pose = Transform("world", "camera", truth.camera.pose.matrix @ off)
    return _cell(truth, camera, pose, rng)


def solved_cell(seed: int) -> DrawnCell:
    """A cell whose base calibration was solved from 30 + 10 noisy views, as a full run does."""
    cell = numeric_cell(seed)
    camera = solve_intrinsic(cell.intrinsic, cell.factory.image_size).camera
    pose = solve_hand_eye(cell.hand_eye, "eye-to-hand", camera=camera).camera_pose
    return _cell(cell.truth, camera, pose, np.random.default_rng([seed, 55]))


def _cell(
    truth: Truth, camera: CameraModel, pose: Transform, rng: np.random.Generator
) -> DrawnCell:
    pictures = marker_pictures(truth.projector.lens.size)
    centres = {i: c for picture in pictures for i, c in picture.centres.items()}
    seen = [_seen(truth, picture.centres, rng) for picture in pictures]
    preset = truth.preset.projector
    lens = LensPrior(preset.throw_ratio * preset.size_px[0], np.array(preset.centre_px))
    projector = solve_projector(seen, centres, camera, lens=lens).map
    grid = Grid(truth)
    base = Calibration(camera, pose, Plane.horizontal(grid.height), projector)
    return DrawnCell(truth, base, grid)


def _seen(truth: Truth, centres: dict[int, Array], rng: np.random.Generator) -> dict[int, Array]:
    ids = sorted(centres)
    pixels = truth.camera.project(truth.light_lands(np.array([centres[i] for i in ids])))
    pixels = pixels + rng.normal(0.0, MARKER_PX, pixels.shape)
    inside = np.all((pixels > 5) & (pixels < np.array(truth.camera.lens.size) - 5), axis=1)
    return {i: p for i, p, ok in zip(ids, pixels, inside, strict=True) if ok}
