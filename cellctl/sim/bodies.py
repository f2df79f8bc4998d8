"""The solid things that the arm moves: its links, the bracket's tray, the boards and the pen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cellctl.arms import JOINTS
from cellctl.geometry import Array, transform_points
from cellctl.sim.textures import border
from cellctl.sim.truth import Board, Truth
from cellctl.sim.view import Capsule, Plate

TRAY_BEHIND_M = 0.004
"""The boards are glued onto a tray whose front is this far behind them."""
PEN_RADIUS_M = 0.006
ARM_ALBEDO, TRAY_ALBEDO, PEN_ALBEDO = 0.45, 0.18, 0.3


@dataclass(frozen=True, eq=False)
class Body:
    """A solid in the DH frame `frame` of the true arm (6: the flange). Bodies of one `group` do
    not shade each other."""

    name: str
    frame: int
    shape: Capsule | Plate
    group: str
    albedo: float

    def placed(self, frames: Array, T_lens_world: Array) -> Capsule | Plate:
        """The shape in a lens's frame; `frames` (7, 4, 4) are the arm's true link frames."""
        pose = T_lens_world @ frames[self.frame]
        if isinstance(self.shape, Plate):
            return Plate(pose @ self.shape.pose, self.shape.centre, self.shape.half)
        ends = transform_points(pose, np.stack([self.shape.start, self.shape.end]))
        return Capsule(ends[0], ends[1], self.shape.radius)


def bodies(truth: Truth) -> tuple[Body, ...]:
    """Everything that moves, as it truly is. Boards are in the group of their own name."""
    links = [
        Body(f"link {c.frame}", c.frame, Capsule(np.array(c.start), np.array(c.end), c.radius),
             "arm", ARM_ALBEDO)
        for c in truth.arm.links
    ]  # fmt: skip
    sheets = {name: sheet(board, truth) for name, board in truth.boards.items()}
    tray = _tray(list(sheets.values()))
    pen = Capsule(tray.pose[:3, 3], truth.pen - (0.0, 0.0, PEN_RADIUS_M), PEN_RADIUS_M)
    return (
        *links,
        Body("tray", JOINTS, tray, "arm", TRAY_ALBEDO),
        Body("pen", JOINTS, pen, "arm", PEN_ALBEDO),
        *(Body(name, JOINTS, plate, name, 1.0) for name, plate in sheets.items()),
    )


def sheet(board: Board, truth: Truth) -> Plate:
    """The board's printed sheet with its white border, flat, in the flange frame."""
    half = board.half + border(board.name, truth.preset.boards)
    return Plate(board.pose.matrix, board.centre * board.scale, half * board.scale)


def plate_points(plate: Plate, spacing: float) -> Array:
    """Points (n, 3) on a plate, at most `spacing` apart, in its parent's frame."""
    steps = [np.linspace(-1.0, 1.0, 1 + int(np.ceil(2 * h / spacing))) for h in plate.half]
    grid = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2) * plate.half + plate.centre
    return transform_points(plate.pose, np.column_stack([grid, np.zeros(len(grid))]))


def _tray(sheets: list[Plate]) -> Plate:
    """The smallest rectangle along the flange's axes behind all sheets."""
    corners = np.concatenate([plate_points(plate, spacing=10.0) for plate in sheets])
    low, high = corners.min(axis=0), corners.max(axis=0)
    pose = np.eye(4)
    behind = sheets[0].pose[2, 2]  # 1: the boards face backwards
    pose[2, 3] = high[2] + TRAY_BEHIND_M if behind > 0 else low[2] - TRAY_BEHIND_M
    return Plate(pose, (low + high)[:2] / 2, (high - low)[:2] / 2)
