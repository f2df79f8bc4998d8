"""A calibrated cell: where light goes and where it lands."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from cellctl.calib.camera import CameraModel
from cellctl.calib.plane import Plane
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.refinement import Refinement
from cellctl.calib.table_surface import TableSurface
from cellctl.errors import BadInput
from cellctl.geometry import Array, Transform, as_transform

__all__ = ["Calibration", "Plane"]

FORMAT = "cellctl-calibration/1"
LATER = {"refinement", "surface", "quality"}
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything needed to light a point of the table, in the frame of the robot's base.

    `boards` holds T_flange_<board> by the board's name. `table` lies in the world frame.
    `raw_pixels` marks the baselines whose homography works on raw camera pixels (divided by K):
    there a world point is pictured with distortion, which the homography then has to absorb.
    `refinement`, where there is one, stands between camera and projector: where the pose has a
    point in the undistorted picture -> where drawn circles show it. `surface` is the table as it
    was measured, with bow and uncertainty; `table` is its plane. `quality` holds JSON: held-out
    errors, covariances, what is known of the pen.
    """

    camera: CameraModel
    T_world_camera: Transform
    table: Plane
    projector: ProjectorMap
    boards: Mapping[str, Transform] = field(default_factory=dict)
    raw_pixels: bool = False
    refinement: Refinement | None = None
    surface: TableSurface | None = None
    quality: Mapping[str, Any] = field(default_factory=dict)

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

    @property
    def table_frame(self) -> Array:
        """T_camera_table (4, 4): of a frame on the table's plane, whose x and y are the world's as
        seen from above."""
        foot = np.array([0.0, 0.0, float(self.table.height(np.zeros(2)))])
        normal = self.table.normal * np.sign(self.table.normal[2])
        x = np.cross((0.0, 1.0, 0.0), normal)
        x /= np.linalg.norm(x)
        frame = np.eye(4)
        frame[:3, :3] = np.column_stack([x, np.cross(normal, x), normal])
        frame[:3, 3] = foot
        return self.T_world_camera.inverse().matrix @ frame

    def picture(self, points: ArrayLike) -> Array:
        """Camera pixels (n, 2), raw, of the points (x, y) of the world, (n, 2), on the table."""
        return self.camera.project(self.T_world_camera.inverse().apply(self._on_table(points)))

    def on(self, surface: TableSurface) -> Calibration:
        """The same cell with this table, as it was measured. A refinement was made for another
        table, and is left out."""
        return replace(self, table=surface.plane, surface=surface, refinement=None)

    def project(self, points: ArrayLike) -> Array:
        """Projector pixels (n, 2) that light the points (x, y) of the world, (n, 2), on the table.
        With (n, 3) the height is not looked at: light is only known where it lands."""
        in_camera = self.T_world_camera.inverse().apply(self._on_table(points))
        if self.raw_pixels:
            xy = self.camera.plane(self.camera.project(in_camera))
        else:
            xy = in_camera[..., :2] / in_camera[..., 2:]
        if self.refinement is not None:
            xy = self.refinement.apply(xy)
        return self.projector.project(xy)

    def _on_table(self, points: ArrayLike) -> Array:
        ground = np.asarray(points, dtype=float)[..., :2]
        return np.concatenate([ground, self.table.height(ground)[..., None]], axis=-1)

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
            "refinement": self.refinement and self.refinement.to_dict(),
            "surface": self.surface and self.surface.to_dict(),
            "quality": dict(self.quality),
        }

    @classmethod
    def from_dict(cls, value: Any, where: str = "calibration") -> Calibration:
        """Read `to_dict`'s form; what was added later (LATER) may be missing. BadInput says
        `where`, the key, and what is wrong with it."""
        if not isinstance(value, dict) or value.get("format") != FORMAT:
            found = value.get("format") if isinstance(value, dict) else type(value).__name__
            raise BadInput(f"{where}: the format must be {FORMAT!r}, not {found!r}")
        _check_keys(value, where)
        return cls(
            camera=CameraModel.from_dict(value["camera"], f"{where}: camera"),
            T_world_camera=as_transform("world", "camera", value["T_world_camera"], where),
            table=Plane.from_dict(value["table"], f"{where}: table"),
            projector=ProjectorMap.from_dict(value["projector"], f"{where}: projector"),
            boards={
                name: as_transform("flange", name, pose, f"{where}: boards")
                for name, pose in value["boards"].items()
            },
            raw_pixels=value["raw_pixels"],
            refinement=_later(value, "refinement", Refinement.from_dict, where),
            surface=_later(value, "surface", TableSurface.from_dict, where),
            quality=_later(value, "quality", _mapping, where) or {},
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
    if unknown := sorted(set(value) - set(kinds) - LATER):
        raise BadInput(f"{where}: unknown key {unknown[0]!r}")


def _later(value: dict[str, Any], key: str, read: Callable[[Any, str], T], where: str) -> T | None:
    """Calibrations from before there was such a thing lack the key."""
    found = value.get(key)
    return None if found is None else read(found, f"{where}: {key}")


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise BadInput(f"{where}: must be an object, not {type(value).__name__}")
    return value
