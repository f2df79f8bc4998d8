"""The standard world, pinned: every number of the table in the project's specification.

Whoever wants another world makes another preset; these numbers are not to be made kinder.
"""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.geometry import Transform, rotation_angle
from cellctl.sim.cell_config import cell_document
from cellctl.sim.grid import touched_height
from cellctl.sim.presets import CR, IR
from cellctl.sim.truth import draw

PINNED = [
    ("arm", "ur5"),
    ("arm_errors.zero_sigma_deg", 0.03),
    ("arm_errors.length_sigma_m", 0.15e-3),
    ("arm_errors.twist_sigma_deg", 0.01),
    ("arm_errors.repeat_sigma_m", 0.058e-3),
    ("arm_errors.repeat_sigma_deg", 0.02),
    ("arm_errors.drawing_repeat_sigma_deg", 0.01),
    ("pen_sigma_m", 0.5e-3),
    ("pen_slip_sigma_m", 0.15e-3),
    ("pen.travel_m", 5e-3),
    ("pen.line_m", 0.8e-3),
    ("pen.felt_m", 0.2e-3),
    ("pen.felt_sigma_m", 0.03e-3),
    ("pen.eye_sigma_m", 0.1e-3),
    ("table.sheet_margin_m", 0.040),
    ("camera.size_px", (1920, 1080)),
    ("camera.focal_px", (915.0, 914.0)),
    ("camera.centre_px", (958.0, 548.0)),
    ("camera.pixel_sigma", 3.0),
    ("camera.distortion", (0.085, -0.060, 0.0005, -0.0004, 0.012)),
    ("camera.radial_spread", 0.10),
    ("camera.factory_focal_off", 0.003),
    ("camera.factory_centre_off_px", 2.0),
    ("camera.factory_distortion_factor", 0.9),
    ("camera.height_m", 0.8),
    ("camera.tilt_deg", (4.0, -3.0)),
    ("camera.tilt_sigma_deg", 1.0),
    ("camera.aim_sigma_m", 0.020),
    ("camera.noise_sigma", 2.0),
    ("camera.defocus_px", 0.7),
    ("camera.unevenness", 0.30),
    ("camera.frame_rate_hz", 30.0),
    ("camera.exposure_s", 0.0167),
    ("camera.delivery_s", 0.060),
    ("camera.buffers", 4),
    ("projector.size_px", (1920, 1080)),
    ("projector.throw_ratio", 1.55),
    ("projector.distance_m", 1.3),
    ("projector.tilt_deg", (3.0, 2.0)),
    ("projector.tilt_sigma_deg", 1.0),
    ("projector.centre_px", (960.0, 1134.0)),
    ("projector.centre_sigma_px", (6.0, 8.0)),
    ("projector.distortion", (0.02, -0.004)),
    ("projector.latency_s", 0.035),
    ("projector.latency_sigma_s", 0.008),
    ("table.centre_m", (0.0, -0.44, 0.0)),
    ("table.tilt_sigma_rad", 1.5e-3),
    ("table.bow_m", 1.0e-3),
    ("table.bow_off_centre", 0.15),
    ("table.touched_height_off_m", 0.3e-3),
    ("table.area_m", (0.670, 0.375)),
    ("boards.inner_corners", (9, 6)),
    ("boards.square_m", 0.030),
    ("boards.markers", (3, 4)),
    ("boards.marker_m", 0.050),
    ("boards.pitch_m", 0.060),
    ("boards.scale_off", (0.001, 0.005)),
    ("boards.bend_m", 0.3e-3),
    ("tape_off_m", 0.10),
    ("tape_off_deg", 10.0),
]
LARGE = dict(PINNED) | {
    "arm": "irb4600-60/2.05",
    "arm_errors.zero_sigma_deg": 0.02,
    "arm_errors.length_sigma_m": 0.25e-3,
    "camera.size_px": (3840, 2160),
    "camera.focal_px": (1830.0, 1828.0),
    "camera.centre_px": (1916.0, 1096.0),
    "camera.pixel_sigma": 6.0,
    "camera.factory_centre_off_px": 4.0,
    "camera.height_m": 4.0,
    "camera.tilt_deg": (6.0, 4.0),
    "projector.throw_ratio": 1.40,
    "projector.distance_m": 3.3,
    "table.centre_m": (1.3, 0.0, 0.6),
    "table.area_m": (0.750, 1.100),
    "boards.square_m": 0.060,
    "boards.markers": (3, 5),
    "boards.marker_m": 0.080,
    "boards.pitch_m": 0.100,
    "pen.line_m": 2e-3,
}
"""What the large cell has; everything else as in the small one."""
SEEDS = 300


@pytest.fixture(scope="module")
def truths():
    return [draw(CR, seed) for seed in range(SEEDS)]


def found(preset, name):
    for part in name.split("."):
        preset = getattr(preset, part)
    return preset


@pytest.mark.parametrize(("name", "value"), PINNED, ids=[name for name, _ in PINNED])
def test_pinned(name, value):
    assert found(CR, name) == value


@pytest.mark.parametrize(("name", "value"), LARGE.items(), ids=LARGE.keys())
def test_the_large_cell_is_pinned(name, value):
    assert found(IR, name) == value


def test_the_large_cells_light_lies_along_the_table():
    """Its long side along y, 1.24 mm a pixel, over all that is drawn in, and on the table."""
    for seed in range(20):
        truth = draw(IR, seed)
        corners = truth.light_lands(np.array([(0, 0), (1919, 0), (1919, 1079), (0, 1079)]))
        low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
        centre, half = np.array(IR.table.centre_m[:2]), np.array(IR.table.area_m) / 2
        assert (low < centre - 1.1 * half).all()
        assert (high > centre + 1.1 * half).all()
        assert (np.abs(corners[:, :2] - centre) < np.array(IR.table.top_m) / 2).all()
        middle = truth.light_lands(np.array([[959.5, 539.5], [960.5, 539.5]]))
        assert np.linalg.norm(middle[0] - IR.table.centre_m) < 3e-3
        assert np.linalg.norm(middle[1] - middle[0]) == pytest.approx(1.24e-3, rel=0.05)
        assert np.abs((middle[1] - middle[0])[1]) > 1.1e-3


def test_same_seed_same_cell(truths):
    again = draw(CR, 7)
    assert np.array_equal(again.camera.pose.matrix, truths[7].camera.pose.matrix)
    assert np.array_equal(again.arm.d, truths[7].arm.d)
    assert not np.array_equal(truths[8].arm.d, truths[7].arm.d)


def assert_normal(values, mean, sigma):
    """Mean and spread of many draws (n, ...) within five standard errors of what they should be."""
    flat = np.asarray(values, dtype=float).reshape(-1)
    n = flat.size
    assert abs(flat.mean() - mean) < 5 * sigma / np.sqrt(n)
    assert abs(flat.std() / sigma - 1) < 5 / np.sqrt(2 * n)


def test_the_arm_is_drawn_as_specified(truths):
    nominal = truths[0].nominal_arm
    assert_normal(np.degrees([t.arm.theta0 - nominal.theta0 for t in truths]), 0, 0.03)
    assert_normal([t.arm.d - nominal.d for t in truths], 0, 0.15e-3)
    assert_normal([t.arm.a - nominal.a for t in truths], 0, 0.15e-3)
    assert_normal(np.degrees([t.arm.alpha - nominal.alpha for t in truths]), 0, 0.01)
    assert_normal([t.pen - t.nominal_pen for t in truths], 0, 0.5e-3)


def test_the_camera_is_drawn_as_specified(truths):
    for axis, (focal, centre) in enumerate(((915, 958), (914, 548))):
        assert_normal([t.camera.lens.focal[axis] for t in truths], focal, 3)
        assert_normal([t.camera.lens.centre[axis] for t in truths], centre, 3)
    k1, k2, p1, p2, k3 = np.array([t.camera.lens.distortion for t in truths]).T
    assert_normal(k1, 0.085, 0.0085)
    assert_normal(k2, -0.060, 0.006)
    assert np.ptp([p1, p2, k3], axis=1).max() == 0
    assert (p1[0], p2[0], k3[0]) == (0.0005, -0.0004, 0.012)
    tilts = np.degrees([_tilt(t.camera.pose) for t in truths])
    assert_normal(tilts[:, 0], 4, 1)
    assert_normal(tilts[:, 1], -3, 1)
    heights = [t.camera.pose.translation[2] for t in truths]
    assert np.allclose(heights, 0.8)
    seen = np.array([_hit_plane(t.camera.pose) for t in truths])
    assert_normal(seen[:, 0], 0.0, 0.020)
    assert_normal(seen[:, 1], -0.44, 0.020)


def test_the_projector_is_drawn_as_specified(truths):
    assert_normal([t.projector.lens.centre[0] for t in truths], 960, 6)
    assert_normal([t.projector.lens.centre[1] for t in truths], 1134, 8)
    tilts = np.degrees([_tilt(t.projector.pose) for t in truths])
    assert_normal(tilts[:, 0], 3, 1)
    assert_normal(tilts[:, 1], 2, 1)
    for truth in truths[:20]:
        lens = truth.projector.lens
        assert np.allclose(lens.focal, 1.55 * 1920)
        assert np.array_equal(lens.distortion, [0.02, -0.004, 0, 0, 0])
        assert truth.projector.pose.translation[2] == pytest.approx(1.3)
        # The image's middle falls onto the table's; a pixel there is 0.43 mm as specified.
        middle = truth.light_lands(np.array([[959.5, 539.5], [960.5, 539.5]]))
        assert np.linalg.norm(middle[0, :2] - (0.0, -0.44)) < 2e-3
        assert np.linalg.norm(middle[1] - middle[0]) == pytest.approx(0.43e-3, rel=0.05)


def test_table_and_boards_are_drawn_as_specified(truths):
    normals = np.array([t.table.pose.rotation[:, 2] for t in truths])
    assert_normal(normals[:, :2], 0, 1.5e-3)
    for values, size in (
        ([t.table.bow for t in truths], 1e-3),
        ([t.table.off[0] for t in truths], 0.15),
        ([b.bend for t in truths for b in t.boards.values()], 0.3e-3),
    ):
        assert np.allclose(np.abs(values), size)
        assert 0.35 < np.mean(np.array(values) > 0) < 0.65
    off = np.array([b.scale - 1 for t in truths for b in t.boards.values()])
    assert (np.abs(off) >= 0.001).all()
    assert (np.abs(off) <= 0.005).all()
    assert np.abs(off).mean() == pytest.approx(0.003, abs=0.0003)
    assert 0.4 < np.mean(off > 0) < 0.6


def test_the_bow_spans_its_millimetre_from_its_top_to_a_corner(truths):
    for table in (t.table for t in truths[:10]):
        top, corner = table.off * table.half_lit, (table.off + 1) * table.half_lit
        assert table.height(top) - table.height(corner) == pytest.approx(table.bow)


def test_what_the_robot_knows_of_the_height_is_off_by_the_pinned_amount():
    steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 2), axis=-1).reshape(-1, 2)
    for seed in range(6):
        truth = draw(CR, seed)
        spots = steps * np.array(CR.table.area_m) / 2
        surface = truth.table.pose.translation[2] + truth.table.height(spots).mean()
        assert abs(touched_height(truth) - surface) == pytest.approx(0.3e-3, abs=1e-5)


def test_tape_measured_poses_are_within_the_tape_and_fill_it():
    shifts, turns = [], []
    for seed in range(40):
        truth, document = draw(CR, seed), cell_document(CR, seed)
        pairs = [
            (document["camera"]["pose"], truth.camera.pose),
            (document["projector"]["pose"], truth.projector.pose),
            (document["table"]["pose"], truth.table.pose),
            (document["bracket"]["checkerboard"]["pose"], truth.boards["checkerboard"].pose),
            (document["bracket"]["markers"]["pose"], truth.boards["markers"].pose),
        ]
        for taped, true in pairs:
            pose = Transform.from_rpy_deg("a", "b", taped["rpy_deg"], taped["position_m"])
            shifts.append(np.linalg.norm(pose.translation - true.translation))
            turns.append(np.degrees(rotation_angle(pose.rotation @ true.rotation.T)))
    assert max(shifts) <= 0.10
    assert max(turns) <= 10.0
    assert np.mean(shifts) == pytest.approx(0.05, abs=0.01)
    assert np.mean(turns) == pytest.approx(5.0, abs=1.0)


def test_factory_values_are_off_as_specified():
    for seed in range(20):
        lens, document = draw(CR, seed).camera.lens, cell_document(CR, seed)
        factory = document["camera"]["factory"]
        off = np.array(factory["focal_px"]) / lens.focal - 1
        assert np.abs(off) == pytest.approx([0.003, 0.003], abs=1e-5)
        centre = np.abs(np.array(factory["centre_px"]) - lens.centre)
        assert centre == pytest.approx([2.0, 2.0], abs=0.006)
        assert factory["distortion"] == pytest.approx(0.9 * lens.distortion, abs=1e-6)


def _tilt(pose):
    """The two tilts (rad) of a device that hangs with its x axis along the world's."""
    x, y, z = pose.rotation[:, 2]
    return np.arctan2(y, -z), np.arctan2(x, np.hypot(y, z))


def _hit_plane(pose):
    origin, axis = pose.translation, pose.rotation[:, 2]
    return (origin - axis * origin[2] / axis[2])[:2]
