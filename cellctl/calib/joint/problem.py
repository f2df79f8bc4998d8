"""Everything that was seen as one least-squares problem for `schur.minimise`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cellctl.calib.chain import SCALE_SIGMA, WARP_SIGMA, Chain, ChainState, PosePrior
from cellctl.calib.joint.observations import Circles, Lit, LitBoard
from cellctl.calib.joint.pictures import Picture, light_on_board, light_on_table, pen
from cellctl.calib.joint.state import Field, FullProjector, JointState, Layout
from cellctl.calib.pose import adjoint, pose_vector_derivatives, pose_vectors
from cellctl.calib.refine_fit import TCP_PRIOR_MM, rotations
from cellctl.calib.schur import Linearised, Priors
from cellctl.geometry import Array, invert

CENTRE_SIGMA_PX, RADIAL_SIGMA, FOCAL_SIGMA = 15.0, 0.1, 0.1
"""Of a projector, before anything was seen: its centre about the data sheet's, k1 and k2, and,
where it is free, the focal length's logarithm."""
PEN_LENGTH_SIGMA_M = 1e-3
ROBOT_COMMON = 2.0
"""A robot's error is smooth: what all views share is as large as what scatters between them, and
more. In standard deviations of the latter."""
TABLE_SIGMA_M = (5e-3, 5e-3, 5e-3, 2e-3, 2e-3, 2e-3)
"""Of the table's coefficients about the start's, where nobody touched it: in the middle, by what
the edges tilt, and by what they bow."""


@dataclass(frozen=True, eq=False)
class ViewGroup:
    """Views of one board: `chain` without noises, the place of their corrections, `columns` of
    their unknowns. `free_pose`: the robot says nothing about them."""

    name: str
    board: str
    chain: Chain
    views: slice
    columns: Array
    ids: tuple[str, ...]
    free_pose: bool

    def chain_state(self, state: JointState) -> ChainState:
        board, one = state.boards[self.board], np.eye(4)
        return ChainState(
            camera=state.camera,
            camera_pose=one if self.free_pose else invert(state.robot_off) @ state.camera_pose,
            board_pose=one if self.free_pose else board.pose,
            corrections=state.corrections[self.views],
            log_scale=0.0 if self.free_pose else board.log_scale,
            warp=board.warp,
        )


@dataclass(frozen=True, eq=False)
class LensPrior:
    """What the start says of the projector's lens: centre (2,) px and focal length px."""

    centre: Array
    focal: float


@dataclass(frozen=True, eq=False)
class JointProblem:
    """See schur.Problem. `sigma` holds the noises by the name of their group: "<views>" in px,
    "turn" in rad, "shift" in m, "touch" in m, "markers" and "lit" in px, "draw", "field" and
    "bend" in mm. `mm` (n, 2, 2): millimetres on the table by a camera pixel, at the circles."""

    layout: Layout
    groups: tuple[ViewGroup, ...]
    touches: Array
    markers: Lit
    lit: tuple[LitBoard, ...]
    circles: Circles
    mm: Array
    look: Array
    field: Field | None
    bend: Field | None
    lens: LensPrior | None
    table_start: Array
    sigma: Mapping[str, float]

    def with_sigma(self, sigma: Mapping[str, float]) -> JointProblem:
        return replace(self, sigma=dict(sigma))

    @cached_property
    def turn(self) -> Array:
        """R(yaw) (n, 2, 2) of the circles."""
        return rotations(self.circles.yaw)

    @cached_property
    def lit_places(self) -> list[tuple[ViewGroup, int]]:
        """The group and the number in it of each lit board's view."""
        groups = {group.name: group for group in self.groups}
        return [(groups[one.group], groups[one.group].ids.index(one.view)) for one in self.lit]

    @property
    def robot_sigma(self) -> Array:
        return np.repeat([self.sigma["turn"], self.sigma["shift"]], 3)

    def residuals(self, state: JointState) -> list[Array]:
        found = [
            group.chain.errors(group.chain_state(state)) / self.sigma[group.name]
            for group in self.groups
        ]
        return found + [part.residuals for part in self.global_parts(state).values()]

    def linearise(self, state: JointState) -> list[Linearised]:
        return list(self.parts(state).values())

    def parts(self, state: JointState) -> dict[str, Linearised]:
        """By the name of the noise; light on boards by "lit 0", "lit 1" and so on."""
        found = {group.name: self._views(group, state) for group in self.groups}
        return found | self.global_parts(state)

    def global_parts(self, state: JointState) -> dict[str, Linearised]:
        """What is not a view of a board."""
        found: dict[str, Linearised] = {}
        if len(self.touches):
            found["touch"] = self._touches(state)
        if len(self.markers):
            picture = light_on_table(state, self.look, self.bend, self.markers.projector_px)
            found["markers"] = self._pictured(
                state, picture, self.markers.camera_px, np.eye(2) / self.sigma["markers"]
            )
        for i, one in enumerate(self.lit):
            found[f"lit {i}"] = self._lit(state, one, *self.lit_places[i])
        if len(self.circles):
            picture = pen(state, self.look, self.field, self.circles.xy, self.turn)
            found["draw"] = self._pictured(
                state, picture, self.circles.pixels, self.mm / self.sigma["draw"]
            )
        return found

    def _views(self, group: ViewGroup, state: JointState) -> Linearised:
        linear = group.chain.linearise(group.chain_state(state))
        by_globals, columns = linear.by_globals, group.columns
        if "robot" in self.layout and not group.free_pose:
            start = len(group.chain.free.intrinsics)
            by_robot = linear.by_globals[..., start : start + 6] @ -adjoint(
                invert(state.camera_pose) @ state.robot_off
            )
            by_globals = np.concatenate([by_globals, by_robot], axis=-1)
            columns = np.concatenate([columns, self.layout.columns(["robot"])])
        weight = 1.0 / self.sigma[group.name]
        return Linearised(
            linear.residuals * weight,
            by_globals * weight,
            linear.by_locals * weight,
            columns,
            group.views,
        )

    def _touches(self, state: JointState) -> Linearised:
        xy, z = self.touches[:, :2], self.touches[:, 2]
        basis = state.table.basis(xy)
        off = (basis @ state.table.coefficients - basis[:, :3] @ state.level - z) / self.sigma[
            "touch"
        ]
        slopes = np.column_stack([basis, -basis[:, :3]])[None, :, None] / self.sigma["touch"]
        columns = self.layout.columns(["table", "level"])
        return Linearised(off[None, :, None], slopes, slopes[..., :0], columns, slice(0, 0))

    def _lit(self, state: JointState, one: LitBoard, group: ViewGroup, view: int) -> Linearised:
        place = group.views.start + view
        picture = light_on_board(
            state,
            group.chain,
            view,
            group.board,
            state.corrections[place],
            one.light.projector_px,
        )
        whiten = np.eye(2) / self.sigma["lit"]
        part = self._pictured(state, picture, one.light.camera_px, whiten)
        return replace(part, views=slice(place, place + 1))

    def _pictured(
        self, state: JointState, picture: Picture, seen: Array, whiten: Array
    ) -> Linearised:
        """Residuals of what is seen at camera pixels (n, 2), `whiten` (2, 2) or (n, 2, 2)."""
        flat = np.column_stack([picture.xy, np.ones(len(picture.xy))])
        pixels, by_point, by_intrinsics = state.camera.jacobians(flat)
        by_xy = whiten @ by_point[..., :2]
        slopes = {name: by_xy @ slope for name, slope in picture.slopes.items()}
        slopes["camera"] = whiten @ by_intrinsics
        names = [name for name in slopes if name in self.layout]
        none = np.zeros((*pixels.shape, 0))
        by_locals = none if picture.by_correction is None else by_xy @ picture.by_correction
        off = (whiten @ (pixels - seen)[..., None])[..., 0]
        by_globals = np.concatenate([none, *(slopes[name] for name in names)], axis=-1)
        columns = self.layout.columns(names)
        return Linearised(off[None], by_globals[None], by_locals[None], columns, slice(0, 0))

    def retract(self, state: JointState, by_globals: Array, by_locals: Array) -> JointState:
        return self.layout.moved(state, by_globals, by_locals)

    def priors(self, state: JointState) -> Priors:
        blocks = self.global_priors(state)
        count = self.layout.count
        rows, jacobians = [np.zeros(0)], [np.zeros((0, count))]
        for name, (off, slopes) in blocks.items():
            jacobian = np.zeros((len(off), count))
            jacobian[:, self.layout.slices[name]] = slopes
            rows.append(off)
            jacobians.append(jacobian)
        return Priors(np.concatenate(rows), np.concatenate(jacobians), *self.local_priors(state))

    def local_priors(self, state: JointState) -> tuple[Array, Array]:
        """Whitened residuals (n, 6) of the views' corrections, and derivatives (n, 6, 6); zero
        where the robot says nothing."""
        vectors = pose_vectors(state.corrections) / self.robot_sigma
        slopes = pose_vector_derivatives(state.corrections) / self.robot_sigma[:, None]
        for group in self.groups:
            if group.free_pose:
                vectors[group.views] = 0.0
                slopes[group.views] = 0.0
        return vectors, slopes

    def global_priors(self, state: JointState) -> dict[str, tuple[Array, Array]]:
        """Whitened residuals (r,) and derivatives (r, c) of what is known beforehand, by the
        name of the unknowns."""
        found: dict[str, tuple[Array, Array]] = {}

        def add(name: str, off: Array, sigma: Array) -> None:
            if name in self.layout:
                found[name] = (off / sigma, np.diag(1.0 / np.broadcast_to(sigma, off.shape)))

        add("tcp", state.tcp, np.full(2, 1e-3 * TCP_PRIOR_MM))
        half = (state.table.area.high - state.table.area.low) / 2
        edges = ROBOT_COMMON * self.sigma["turn"] * half
        add("level", state.level, np.append(PEN_LENGTH_SIGMA_M, edges))
        off = state.table.coefficients - self.table_start
        add("table", off, np.array(TABLE_SIGMA_M[: len(off)]))
        common = ROBOT_COMMON * self.robot_sigma
        for name, off_pose in (("robot", state.robot_off), ("look", state.look_off)):
            if name in self.layout:
                found[name] = PosePrior(np.eye(4), common).whitened(off_pose)
        for name, board in state.boards.items():
            add(f"{name} scale", np.array([board.log_scale]), np.array([SCALE_SIGMA]))
            size = max(float(g.chain.sheet.half.max()) for g in self.groups if g.board == name)
            add(f"{name} warp", board.warp, np.full(3, WARP_SIGMA * size))
        for name, values in (("field", state.field), ("bend", state.bend)):
            add(name, values.reshape(-1), np.full(values.size, self.sigma[name]))
        if "projector" in self.layout and self.lens is not None:
            found["projector"] = self._projector_prior(state, self.lens)
        return found

    def _projector_prior(self, state: JointState, lens: LensPrior) -> tuple[Array, Array]:
        centre = np.full(2, CENTRE_SIGMA_PX)
        radial = np.full(2, RADIAL_SIGMA)
        if isinstance(state.projector, FullProjector):
            vector = state.projector.lens.vector
            off = [vector[:1] - lens.focal, vector[2:4] - lens.centre, vector[4:6]]
            sigma = np.concatenate([[FOCAL_SIGMA * lens.focal], centre, radial])
            return np.concatenate(off) / sigma, np.eye(5, 11) / sigma[:, None]
        off = [state.projector.radial, state.projector.centre - lens.centre]
        sigma = np.concatenate([radial, centre])
        return np.concatenate(off) / sigma, np.eye(4, 12, k=8) / sigma[:, None]
