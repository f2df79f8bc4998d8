"""What the joint adjustment takes: everything that was seen, and where the robot said it was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cellctl.calib.camera import CameraModel, distort
from cellctl.calib.hand_eye_fit import Mount
from cellctl.calib.refine_fit import Mark
from cellctl.calib.views import RobotView, View
from cellctl.errors import BadInput
from cellctl.geometry import Array, Transform


@dataclass(frozen=True, eq=False)
class BoardViews:
    """Views of one `board` that share a noise, called `name`. `through_robot`: the board's pose
    follows from the robot's, which each view then has; otherwise it is free in each view."""

    name: str
    board: str
    views: Sequence[View]
    through_robot: bool = True

    def __post_init__(self) -> None:
        if self.through_robot and not all(isinstance(v, RobotView) for v in self.views):
            raise BadInput(f"{self.name}: a view has no robot pose; call its board's pose free")


@dataclass(frozen=True, eq=False)
class Lit:
    """Projector pixels (n, 2), exact, and the camera pixels (n, 2) where their light was seen."""

    projector_px: Array
    camera_px: Array

    def __post_init__(self) -> None:
        for name in ("projector_px", "camera_px"):
            value = np.asarray(getattr(self, name), dtype=float).reshape(-1, 2)
            if not np.isfinite(value).all():
                raise BadInput(f"lit points: {name} holds a number that is not finite")
            object.__setattr__(self, name, value)
        if len(self.projector_px) != len(self.camera_px):
            raise BadInput("lit points: projector and camera pixels must be equally many")

    def __len__(self) -> int:
        return len(self.projector_px)

    @classmethod
    def nothing(cls) -> Lit:
        return cls(np.zeros((0, 2)), np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class LitBoard:
    """Light seen on the board of the view `view` (its id) of the group of views `group`."""

    group: str
    view: str
    light: Lit


@dataclass(frozen=True, eq=False)
class Circles:
    """Drawn circles: keys (n), commanded world `xy` (n, 2) m, the tool's `yaw` (n,) rad, and the
    raw camera pixels (n, 2) of their centres, as the centre itself is pictured."""

    keys: tuple[str, ...]
    xy: Array
    yaw: Array
    pixels: Array

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: Any) -> Circles:
        keys = tuple(np.array(self.keys, dtype=object)[index])
        return Circles(keys, self.xy[index], self.yaw[index], self.pixels[index])

    @classmethod
    def of(cls, marks: Sequence[Mark], camera: CameraModel) -> Circles:
        """From marks whose centres were undistorted with `camera`."""
        seen = np.array([mark.seen for mark in marks], dtype=float).reshape(-1, 2)
        return cls(
            keys=tuple(mark.key for mark in marks),
            xy=np.array([mark.xy for mark in marks], dtype=float).reshape(-1, 2),
            yaw=np.array([mark.yaw for mark in marks], dtype=float),
            pixels=camera.pixels(distort(seen, camera.distortion)),
        )

    @classmethod
    def nothing(cls) -> Circles:
        return cls((), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class Observations:
    """All of it. `touches` (n, 3), metres in the world, are points of the table; `markers` light
    on the table; `lit_boards` light on held boards, the second plane. `look`: for a camera on the
    arm, T_world_flange at which table and circles were pictured."""

    mount: Mount = "eye-to-hand"
    views: Sequence[BoardViews] = ()
    touches: Array = field(default_factory=lambda: np.zeros((0, 3)))
    markers: Lit = field(default_factory=Lit.nothing)
    lit_boards: Sequence[LitBoard] = ()
    circles: Circles = field(default_factory=Circles.nothing)
    look: Transform | None = None

    def __post_init__(self) -> None:
        names = [group.name for group in self.views]
        if len(set(names)) < len(names):
            raise BadInput(f"the groups of views need different names, not {names}")
        if self.mount == "eye-in-hand" and self.look is None and len(self.markers):
            raise BadInput("a camera on the arm: the pose at which it saw the table is missing")
