"""A calibrated cell: where light goes and where it lands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cellctl.calib.camera import CameraModel
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.refinement import Refinement
from cellctl.errors import BadInput
from cellctl.geometry import Array, Transform, as_transform

FORMAT = "cellctl-calibration/1"


@dataclass(frozen=True, eq=False)
class Plane:
    """All p with normal . (p - point) = 0; both (3,), in the world frame, metres."""

    point: Array
    normal: Array

    def __post_init__(self) -> None:
        for name in ("point", "normal"):
            try:
                vector = np.array(getattr(self, name), dtype=float)
            except (TypeError, ValueError):
                vector = np.zeros(0)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise BadInput(f"plane: {name} must be three finite numbers")
            vector.flags.writeable = False
            object.__setattr__(self, name, vector)
        if not abs(np.linalg.norm(self.normal) - 1.0) < 1e-6:
            raise BadInput("plane: the normal must have the length 1")

    @classmethod
    def horizontal(cls, height: float) -> Plane:
        """z = `height` metres."""
        return cls(np.array([0.0, 0.0, height]), np.array([0.0, 0.0, 1.0]))

    def intersect(self, origin: Array, directions: Array) -> Array:
        """Where the lines from origin (3,) along directions (..., 3) meet it."""
        along = ((self.point - origin) @ self.normal) / (directions @ self.normal)
        return origin + directions * along[..., None]

    def to_dict(self) -> dict[str, Any]:
        return {"point": self.point.tolist(), "normal": self.normal.tolist()}


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything needed to light a point of the table, in the frame of the robot's base.

    `boards` holds T_flange_<board> by the board's name. `table` lies in the world frame.
    `raw_pixels` marks the baselines whose homography works on raw camera pixels (divided by K):
    there a world point is pictured with distortion, which the homography then has to absorb.
    `refinement`, where there is one, stands between camera and projector: where the pose has a
    point in the undistorted picture -> where drawn circles show it.
    """

    camera: CameraModel
    T_world_camera: Transform
    table: Plane
    projector: ProjectorMap
    boards: Mapping[str, Transform] = field(default_factory=dict)
    raw_pixels: bool = False
    refinement: Refinement | None = None

    def __post_init__(self) -> None:
        if self.raw_pixels and self.refinement is not None:
            raise BadInput("calibration: a refinement needs undistorted pixels, not raw ones")

    @property
    def table_homography(self) -> Array:
        """(3, 3): world (x, y) on the table, metres -> undistorted normalised camera
        coordinates, without the refinement."""
        slope = -self.table.normal[:2] / self.table.normal[2]
        height = self.table.point[2] - slope @ self.table.point[:2]
        lift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [*slope, height], [0.0, 0.0, 1.0]])
        return (self.T_world_camera.inverse().matrix @ lift)[:3]

    def project(self, points: ArrayLike) -> Array:
        """Projector pixels (n, 2) that light the world points (n, 3), which lie on the table."""
        in_camera = self.T_world_camera.inverse().apply(points)
        if self.raw_pixels:
            xy = self.camera.plane(self.camera.project(in_camera))
        else:
            xy = in_camera[..., :2] / in_camera[..., 2:]
        if self.refinement is not None:
            xy = self.refinement.apply(xy)
        return self.projector.project(xy)

    def locate(self, pixels: ArrayLike) -> Array:
        """World points (n, 3) on the table that the projector pixels (n, 2) light."""
        xy = self.projector.locate(np.asarray(pixels, dtype=float))
        if self.raw_pixels:
            xy = self.camera.normalise(self.camera.pixels(xy))
        if self.refinement is not None:
            xy = self.refinement.undo(xy)
        rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        directions = rays @ self.T_world_camera.rotation.T
        return self.table.intersect(self.T_world_camera.translation, directions)

    def to_dict(self) -> dict[str, Any]:
        """JSON form; floats survive exactly. Transforms map points of the child frame, named
        last, into the parent frame: p_world = T_world_camera p_camera."""
        return {
            "format": FORMAT,
            "camera": self.camera.to_dict(),
            "T_world_camera": self.T_world_camera.to_list(),
            "table": self.table.to_dict(),
            "projector": self.projector.to_dict(),
            "boards": {name: pose.to_list() for name, pose in sorted(self.boards.items())},
            "raw_pixels": self.raw_pixels,
            "refinement": None if self.refinement is None else self.refinement.to_dict(),
        }

    @classmethod
    def from_dict(cls, value: Any, where: str = "calibration") -> Calibration:
        """Read `to_dict`'s form; the key `refinement` may be missing. BadInput says `where`, the
        key, and what is wrong with it."""
        if not isinstance(value, dict) or value.get("format") != FORMAT:
            found = value.get("format") if isinstance(value, dict) else type(value).__name__
            raise BadInput(f"{where}: the format must be {FORMAT!r}, not {found!r}")
        _check_keys(value, where)
        return cls(
            camera=CameraModel.from_dict(value["camera"], f"{where}: camera"),
            T_world_camera=as_transform("world", "camera", value["T_world_camera"], where),
            table=_plane(value["table"], where),
            projector=ProjectorMap.from_dict(value["projector"], f"{where}: projector"),
            boards={
                name: as_transform("flange", name, pose, f"{where}: boards")
                for name, pose in value["boards"].items()
            },
            raw_pixels=value["raw_pixels"],
            refinement=_refinement(value.get("refinement"), f"{where}: refinement"),
        )


def _check_keys(value: dict[str, Any], where: str) -> None:
    kinds = {
        "format": str,
        "camera": dict,
        "T_world_camera": list,
        "table": dict,
        "projector": dict,
        "boards": dict,
        "raw_pixels": bool,
    }
    for key, kind in kinds.items():
        if key not in value:
            raise BadInput(f"{where}: missing key {key!r}")
        if not isinstance(value[key], kind):
            raise BadInput(f"{where}: {key} must be a {kind.__name__}")
    if unknown := sorted(set(value) - set(kinds) - {"refinement"}):
        raise BadInput(f"{where}: unknown key {unknown[0]!r}")


def _refinement(value: Any, where: str) -> Refinement | None:
    """Calibrations from before there were refinements lack the key."""
    return None if value is None else Refinement.from_dict(value, where)


def _plane(value: dict[str, Any], where: str) -> Plane:
    try:
        return Plane(value["point"], value["normal"])
    except KeyError as error:
        raise BadInput(f"{where}: table: missing key {error}") from None
    except BadInput as error:
        raise BadInput(f"{where}: table: {error.message}") from None
