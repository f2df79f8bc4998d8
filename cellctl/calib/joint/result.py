"""What the joint adjustment found, as a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.homography import apply_homography
from cellctl.calib.joint.noise import Component, components, information
from cellctl.calib.joint.observations import Observations
from cellctl.calib.joint.pictures import light_on_table, pen, world_camera
from cellctl.calib.joint.problem import JointProblem
from cellctl.calib.joint.state import FullProjector, JointState, Layout
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.refinement import Refinement, kernel_values
from cellctl.calib.schur import Solution
from cellctl.geometry import Array, Transform

GRID = 11


@dataclass(frozen=True, eq=False)
class JointResult:
    """What was seen, where the adjustment began, and where it ended."""

    seen: Observations
    start: Calibration
    solution: Solution[JointState]

    @cached_property
    def components(self) -> Mapping[str, Component]:
        """Squares and redundancy of each group of observations."""
        return components(self.solution)

    @cached_property
    def information(self) -> Mapping[str, Array]:
        """What each unit of each group tells about the globals, see `noise.information`."""
        return information(self.solution)

    @property
    def problem(self) -> JointProblem:
        assert isinstance(self.solution.problem, JointProblem)
        return self.solution.problem

    @property
    def state(self) -> JointState:
        return self.solution.state

    @property
    def layout(self) -> Layout:
        return self.problem.layout

    @property
    def sigma(self) -> Mapping[str, float]:
        """Noise of each group of observations, units as in JointProblem."""
        return {n: s for n, s in self.problem.sigma.items() if n in self.components}

    @cached_property
    def covariance(self) -> Array:
        """(g, g) of the globals, in the order of `layout`; poses by small turns (rad) and shifts
        (m) in their child frame."""
        return self.solution.globals_covariance

    def covariance_of(self, name: str) -> Array:
        """That of one group of unknowns, of Layout's names. KeyError for what was not free."""
        place = self.layout.slices[name]
        return self.covariance[place, place]

    @cached_property
    def calibration(self) -> Calibration:
        """With the pen's offset and the smooth displacements of what is drawn as a refinement of
        the family "joint", and those of what is lit in the projector's map."""
        state = self.state
        T = world_camera(state, self.problem.look)
        plain = Calibration(
            camera=state.camera,
            T_world_camera=Transform("world", "camera", T),
            table=state.table.plane,
            projector=projector_map(state, T),
            boards={
                name: Transform("flange", name, board.pose)
                for name, board in state.boards.items()
                if f"{name} pose" in self.layout and self.seen.mount == "eye-to-hand"
            },
        )
        return replace(
            plain,
            refinement=self._refinement(plain),
            projector=replace(plain.projector, bend=self._bend(plain.projector)),
        )

    def _refinement(self, plain: Calibration) -> Refinement | None:
        """Where the pen is seen, of where `plain` has the commanded place. The pen's offset is a
        shift of the table's plane; displacements move with it."""
        if not len(self.seen.circles):
            return None
        field, table = self.problem.field, plain.table_homography
        shift = np.eye(3)
        shift[:2, 2] = self.state.tcp
        H = table @ shift @ np.linalg.inv(table)
        if field is None:
            return Refinement("joint", H=H / H[2, 2])
        scaled = np.diag([field.scale, field.scale, 1.0])
        scaled[:2, 2] = field.centre
        H = np.linalg.inv(scaled) @ H @ scaled
        displaced = field.refinement(self.state.field)
        nodes = apply_homography(np.linalg.inv(H), field.nodes)
        found = replace(displaced, H=H / H[2, 2], nodes=nodes)
        if self.state.table.kind == "plane":
            return found
        turns = np.broadcast_to(np.eye(2), (GRID**2, 2, 2))
        exact = pen(self.state, self.problem.look, field, self.places, turns).xy
        at = apply_homography(table, self.places)
        return replace(found, weights=found.weights + _weights(found, at, exact - found.apply(at)))

    def _bend(self, plain: ProjectorMap) -> Refinement | None:
        """From where `plain` has a pixel's light to where it is seen."""
        field = self.problem.bend
        if field is None or not self.state.bend.size:
            return None
        found = field.refinement(self.state.bend)
        if isinstance(self.state.projector, ProjectorMap) or self.state.table.kind == "plane":
            return found
        world = self.state.table.points(self.places)
        pixels = self.state.projector.project(world)
        exact = light_on_table(self.state, self.problem.look, self.problem.bend, pixels).xy
        at = plain.locate(pixels)
        return replace(found, weights=found.weights + _weights(found, at, exact - found.apply(at)))

    @property
    def places(self) -> Array:
        """(GRID^2, 2) over the area that counts, metres."""
        area = self.state.table.area
        steps = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, GRID)] * 2), axis=-1).reshape(-1, 2)
        return area.low + steps * (area.high - area.low)


def _weights(kernel: Refinement, at: Array, gaps: Array) -> Array:
    """Of the kernel's functions that together displace camera coordinates (n, 2) by (n, 2)."""
    phi = kernel_values(kernel.kernel, kernel.length, kernel.scaled(at), kernel.nodes)
    return np.linalg.lstsq(phi, gaps / kernel.scale, rcond=1e-6)[0]


def projector_map(state: JointState, T_world_camera: Array) -> ProjectorMap:
    """The map from the camera's plane by way of the table's plane. That of a full projector has
    its lens exactly; a table's bow is left out."""
    if isinstance(state.projector, ProjectorMap):
        return state.projector
    full: FullProjector = state.projector
    plane, lens = state.table.plane, full.lens
    # X = C + r (n.(q - C) / n.r): linear in the ray r up to scale.
    C, R = T_world_camera[:3, 3], T_world_camera[:3, :3]
    to_world = (np.outer(C, plane.normal) + ((plane.point - C) @ plane.normal) * np.eye(3)) @ R
    offset = plane.normal @ R  # the homogeneous coordinate n.r
    inverse = np.linalg.inv(full.pose)
    H = lens.K @ (inverse[:3, :3] @ to_world + np.outer(inverse[:3, 3], offset))
    return ProjectorMap(H / H[2, 2], lens.K[:2, 2], lens.K[0, 0], lens.distortion[:2])
