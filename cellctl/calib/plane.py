"""A plane in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.errors import BadInput
from cellctl.geometry import Array


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

    def height(self, xy: Array) -> Array:
        """z (...,) at xy (..., 2), metres."""
        return self.point[2] - (xy - self.point[:2]) @ self.normal[:2] / self.normal[2]

    def to_dict(self) -> dict[str, Any]:
        return {"point": self.point.tolist(), "normal": self.normal.tolist()}

    @classmethod
    def from_dict(cls, value: Any, where: str = "plane") -> Plane:
        """Read `to_dict`'s form. BadInput says `where` and what is wrong."""
        try:
            return cls(value["point"], value["normal"])
        except KeyError as error:
            raise BadInput(f"{where}: missing key {error}") from None
        except TypeError:
            raise BadInput(f"{where}: must be an object with point and normal") from None
        except BadInput as error:
            raise BadInput(f"{where}: {error.message}") from None
