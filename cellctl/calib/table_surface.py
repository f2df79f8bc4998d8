"""The surface of a table: a plane, perhaps bowed, and how well it is known where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from cellctl.calib.calibration import Plane
from cellctl.calib.views import Rejection
from cellctl.errors import BadInput
from cellctl.geometry import Array

FORMAT = "cellctl-table/1"
GRID = 21

TERMS = {"plane": 3, "bow": 5, "bow and twist": 6}
"""What may be fitted, simplest first: unknowns of each."""


@dataclass(frozen=True, eq=False)
class Area:
    """A rectangle of the world's x and y, metres: `low` (2,) and `high` (2,)."""

    low: Array
    high: Array

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            value = numbers(getattr(self, name), f"area: {name}", (2,))
            object.__setattr__(self, name, value)
        if not (self.low <= self.high).all():
            raise BadInput("area: low must not exceed high")

    def grid(self) -> Array:
        """Places (GRID^2, 2) all over it, corners included."""
        share = np.linspace(0.0, 1.0, GRID)[:, None]
        x, y = (self.low + share * (self.high - self.low)).T
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def to_list(self) -> list[list[float]]:
        return [self.low.tolist(), self.high.tolist()]


@dataclass(frozen=True, eq=False)
class TableSurface:
    """z(x, y) = `coefficients` (p,) times 1, u, v[, u^2 - 1/3, v^2 - 1/3[, u v]], where u and v
    run from -1 to 1 over `touched`: the plane is then the one nearest to the surface there.

    `covariance` (p, p) m^2 of the coefficients, `spare` the residuals beyond the p needed;
    `held_out_mm` of every kind that was tried, `kind` the chosen one. `bow_m`: the largest
    distance of the surface from its plane over `area`; `uncertainty_m`: with 95 % the height is
    nowhere in `area` off by more, for the surface as it was fitted.
    """

    kind: str
    coefficients: Array
    covariance: Array
    spare: int
    touched: Area
    area: Area
    rms_mm: float
    held_out_mm: dict[str, float]
    used: tuple[str, ...]
    rejected: tuple[Rejection, ...]

    def height(self, xy: ArrayLike) -> Array:
        """z (n,), metres, at places (n, 2) of the world's x and y; with the bow, which is
        followed beyond the touched extent too and means little there."""
        places = np.asarray(xy, dtype=float)
        return self._basis(places) @ self.coefficients

    @property
    def plane(self) -> Plane:
        """Without the bow."""
        middle, half = _frame(self.touched)
        height, by_u, by_v = self.coefficients[:3]
        normal = np.array([-by_u / half[0], -by_v / half[1], 1.0])
        return Plane(np.append(middle, height), normal / np.linalg.norm(normal))

    @property
    def plane_covariance(self) -> Array:
        """(3, 3) of the plane's height at its point (m) and its slopes along x and y (rad)."""
        _, half = _frame(self.touched)
        scale = np.diag([1.0, 1.0 / half[0], 1.0 / half[1]])
        return scale @ self.covariance[:3, :3] @ scale

    @property
    def bow_m(self) -> float:
        if self.kind == "plane":
            return 0.0
        basis = self._basis(self.area.grid())[:, 3:]
        return float(np.abs(basis @ self.coefficients[3:]).max())

    @property
    def uncertainty_m(self) -> float:
        # Off most in a corner, if it is off: Bonferroni's interval for the four of them.
        return float(_interval(self.spare, 4) * self._sigma(self.area.grid()).max())

    def uncertainty_at(self, xy: ArrayLike) -> Array:
        """Half of the 95 % interval (n,) of the height at places (n, 2), metres."""
        return _interval(self.spare) * self._sigma(np.asarray(xy, dtype=float))

    def _sigma(self, places: Array) -> Array:
        basis = self._basis(places)
        variance = np.einsum("ni,ij,nj->n", basis, self.covariance, basis)
        return np.sqrt(np.maximum(variance, 0.0))

    def _basis(self, places: Array) -> Array:
        return basis(places, self.touched, self.kind)

    def to_dict(self) -> dict[str, Any]:
        """JSON form; floats survive exactly. What follows from the rest is there to be read."""
        return {
            "format": FORMAT,
            "kind": self.kind,
            "coefficients": self.coefficients.tolist(),
            "covariance": self.covariance.tolist(),
            "spare": self.spare,
            "touched": self.touched.to_list(),
            "area": self.area.to_list(),
            "rms_mm": self.rms_mm,
            "held_out_mm": {k: v if np.isfinite(v) else None for k, v in self.held_out_mm.items()},
            "points": {
                "used": list(self.used),
                "rejected": [r.to_dict() for r in self.rejected],
            },
            "plane": self.plane.to_dict(),
            "plane_covariance": self.plane_covariance.tolist(),
            "bow_m": self.bow_m,
            "uncertainty_m": self.uncertainty_m,
        }

    @classmethod
    def from_dict(cls, value: Any, where: str = "table") -> TableSurface:
        """Read `to_dict`'s form. BadInput says `where`, the key, and what is wrong with it."""
        if not isinstance(value, dict) or value.get("format") != FORMAT:
            found = value.get("format") if isinstance(value, dict) else type(value).__name__
            raise BadInput(f"{where}: the format must be {FORMAT!r}, not {found!r}")
        try:
            return _read(value)
        except KeyError as error:
            raise BadInput(f"{where}: missing key {error}") from None
        except (TypeError, ValueError, AttributeError) as error:
            raise BadInput(f"{where}: {error}") from None
        except BadInput as error:
            raise BadInput(f"{where}: {error.message}") from None


def basis(places: Array, touched: Area, kind: str) -> Array:
    """(n, p): what the coefficients of a kind multiply."""
    middle, half = _frame(touched)
    u, v = ((places - middle) / half).T
    terms = [np.ones_like(u), u, v, u * u - 1.0 / 3.0, v * v - 1.0 / 3.0, u * v]
    return np.stack(terms[: TERMS[kind]], axis=-1)


def _frame(touched: Area) -> tuple[Array, Array]:
    """Middle (2,) and half sides (2,)."""
    return (touched.low + touched.high) / 2.0, (touched.high - touched.low) / 2.0


def numbers(value: Any, name: str, shape: tuple[int | None, ...]) -> Array:
    """A read-only copy of finite numbers; None stands for any length. BadInput names them."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"{name}: these are no numbers: {error}") from None
    fits = len(array.shape) == len(shape)
    if not fits or any(b is not None and a != b for a, b in zip(array.shape, shape, strict=True)):
        wanted = " x ".join("n" if side is None else str(side) for side in shape)
        raise BadInput(f"{name} must be {wanted} numbers, not of shape {array.shape}")
    if not np.isfinite(array).all():
        raise BadInput(f"{name}: one is not finite")
    array.flags.writeable = False
    return array


def _interval(spare: int, places: int = 1) -> float:
    """Half the 95 % interval in standard deviations, for so many places at once, when these come
    from `spare` residuals; from none, they are an opinion and taken as certain."""
    tail = 0.025 / places
    return float(stats.t.isf(tail, spare) if spare > 0 else stats.norm.isf(tail))


def _read(value: dict[str, Any]) -> TableSurface:
    kind, spare = value["kind"], value["spare"]
    if kind not in TERMS:
        raise BadInput(f"kind must be one of {', '.join(TERMS)}, not {kind!r}")
    if type(spare) is not int or spare < 0:
        raise BadInput(f"spare must be a whole number, not {spare!r}")
    count, points = TERMS[kind], value["points"]
    return TableSurface(
        kind=kind,
        coefficients=numbers(value["coefficients"], "coefficients", (count,)),
        covariance=numbers(value["covariance"], "covariance", (count, count)),
        spare=spare,
        touched=_area(value["touched"]),
        area=_area(value["area"]),
        rms_mm=float(numbers(value["rms_mm"], "rms_mm", ())),
        held_out_mm={k: _known(v) for k, v in value["held_out_mm"].items()},
        used=tuple(str(name) for name in points["used"]),
        rejected=tuple(Rejection(str(r["id"]), str(r["reason"])) for r in points["rejected"]),
    )


def _area(value: Any) -> Area:
    corners = numbers(value, "an area", (2, 2))
    return Area(corners[0], corners[1])


def _known(value: Any) -> float:
    return float("inf") if value is None else float(numbers(value, "held_out_mm", ()))
