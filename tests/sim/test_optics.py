"""Pictures: unbiased, noisy as specified, lit, shaded and occluded by what is really there."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cellctl.geometry import Transform, pose_matrix
from cellctl.sim.bodies import bodies, plate_points
from cellctl.sim.light import Picture
from cellctl.sim.noise import OFFSET, NoiseBank
from cellctl.sim.optics import Instant, Optics, Renderer
from cellctl.sim.paint import board_hit
from cellctl.sim.presets import CR
from cellctl.sim.truth import draw
from cellctl.sim.view import Plate, Rays, View, dense
from tests.sim.scenes import (
    AWAY,
    DARK,
    board_pixels,
    chessboard_points,
    crossing,
    find_chessboard,
    find_markers,
    flange_showing,
    frames_with_flange,
    marker_corners,
    projected_markers,
    random_flange,
    showing,
    still,
)

SEED = 3
BIAS_PX = 0.02
VIEWS = 16
WIDTH, HEIGHT = CR.camera.size_px
WHITE = np.full((1080, 1920), 255, dtype=np.uint8)


@pytest.fixture(scope="module")
def truth():
    return draw(CR, SEED)


@pytest.fixture(scope="module")
def optics(truth):
    return Optics(truth)


@pytest.fixture(scope="module")
def bank():
    return NoiseBank(SEED, (HEIGHT, WIDTH), CR.camera.noise_sigma)


def assert_unbiased(view_means):
    """The mean over views (n, 2) is within BIAS_PX, with 95 % confidence on either axis."""
    means = np.array(view_means)
    error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    assert (np.abs(means.mean(axis=0)) + 2 * error < BIAS_PX).all(), (means.mean(axis=0), error)


def test_checkerboard_corners_are_unbiased_and_as_noisy_as_real_ones(truth, optics, bank):
    rng, means, spread = np.random.default_rng(1), [], []
    points = chessboard_points(CR.boards)
    for i in range(60):
        flange = random_flange(truth, "checkerboard", rng)
        expected = board_pixels(truth, "checkerboard", flange, points)
        picture = bank.expose(optics.expose(still(frames_with_flange(flange))), f"view {i}")
        corners = find_chessboard(picture, CR.boards, expected)
        if corners is None:
            continue
        errors = corners - expected
        means.append(errors.mean(axis=0))
        spread.append(np.sqrt((errors**2).mean()))
        if len(means) == VIEWS:
            break
    assert len(means) == VIEWS
    assert_unbiased(means)
    assert 0.015 < np.median(spread) < 0.1
    assert max(spread) < 0.15


def test_marker_corners_are_unbiased(truth, optics, bank):
    rng, means = np.random.default_rng(2), []
    for i in range(60):
        flange = random_flange(truth, "markers", rng, distance=(0.35, 0.8))
        picture = bank.expose(optics.expose(still(frames_with_flange(flange))), f"marker view {i}")
        errors = [
            quad - board_pixels(truth, "markers", flange, marker_corners(CR.boards, marker))
            for marker, quad in find_markers(picture).items()
        ]
        if len(errors) == 12:
            means.append(np.mean(errors, axis=(0, 1)))
        if len(means) == VIEWS:
            break
    assert len(means) == VIEWS
    assert_unbiased(means)


def test_projected_marker_centres_are_unbiased():
    image, centres = projected_markers(CR.projector.size_px)
    found_errors = []
    for seed in range(3):
        truth = draw(CR, seed)
        optics, bank = Optics(truth), NoiseBank(seed, (HEIGHT, WIDTH), CR.camera.noise_sigma)
        picture = bank.expose(optics.expose(still(AWAY, showing(image))), "projected")
        found = find_markers(picture, cv2.aruco.DICT_4X4_250)
        assert len(found) > 0.9 * len(centres)
        for marker, quad in found.items():
            lit = truth.light_lands(np.array([centres[marker]]))
            found_errors.append(crossing(quad) - truth.camera.project(lit)[0])
    errors = np.array(found_errors)
    mean, error = errors.mean(axis=0), errors.std(axis=0) / np.sqrt(len(errors))
    assert (np.abs(mean) + 2 * error < BIAS_PX).all(), (mean, error)
    assert errors.std() < 0.15


def test_interpolated_rays_are_the_lens_s_own(truth):
    lens = truth.camera.lens
    view = View(lens)
    pixels = np.array([[0.0, 0.0], [1919, 0], [7, 1079], [958, 548], [333, 777], [1900, 15]])
    columns, rows = pixels.astype(int).T
    exact = lens.rays(pixels)[:, :2]
    found = np.column_stack([view.rays.x[rows, columns], view.rays.y[rows, columns]])
    assert np.abs(found - exact).max() * lens.focal.max() < 1e-3
    assert np.allclose(lens.project(lens.rays(pixels)), pixels, atol=1e-6)


def test_binned_rays_are_those_of_block_middles(truth):
    view = View(truth.camera.lens, binning=4)
    ray = np.array([view.rays.x[10, 20], view.rays.y[10, 20], 1.0])
    assert truth.camera.lens.project(ray) == pytest.approx((4 * 20 + 1.5, 4 * 10 + 1.5), abs=2e-3)


def test_dense_reproduces_smooth_functions():
    pixels = np.stack(np.meshgrid(np.arange(70.0), np.arange(50.0)), axis=-1)
    found = dense(lambda p: np.sin(p / 40.0), (50, 70), 4)
    assert np.abs(np.moveaxis(found, 0, -1) - np.sin(pixels / 40.0)).max() < 1e-5


@pytest.mark.parametrize("name", ["checkerboard", "markers"])
def test_hitting_a_bent_board_inverts_its_surface(truth, name):
    board = truth.boards[name]
    pose = pose_matrix((0.5, -0.6, 1.0), (0.05, -0.02, 0.5))
    nominal = board.centre + np.array([[-1, -1], [1, 0.5], [0, 0], [0.3, 1]]) * board.half
    points = board.surface(nominal) @ pose[:3, :3].T + pose[:3, 3]
    rays = Rays(*(points[:, :2] / points[:, 2:]).T.astype(np.float32))
    x, y, depth = board_hit(board, pose, rays)
    assert np.abs(np.column_stack([x, y]) - nominal).max() < 2e-6
    assert np.abs(depth - points[:, 2]).max() < 2e-6


def test_first_inner_corner_has_black_left_above(truth, optics):
    flange = flange_showing(truth, "checkerboard", 0.5, (0, 0, 0.1), (960, 540))
    signal = optics.expose(still(frames_with_flange(flange)))
    square = CR.boards.square_m
    black, white = (
        signal[tuple(board_pixels(truth, "checkerboard", flange, [p])[0].round().astype(int)[::-1])]
        for p in ((-square / 2, -square / 2), (square / 2, -square / 2))
    )
    assert white > 4 * black


def test_noise_is_as_specified_and_keyed():
    bank = NoiseBank(5, (400, 600), 2.0)
    flat = np.full((400, 600), 100.0, dtype=np.float32)
    one, same, other = (bank.expose(flat, index).astype(float) for index in ("a", "a", "b"))
    assert np.array_equal(one, same)
    assert one.mean() == pytest.approx(100 + OFFSET, abs=0.05)
    assert one.std() == pytest.approx(np.hypot(2.0, 1 / np.sqrt(12)), abs=0.05)
    correlation = np.corrcoef(one.ravel(), other.ravel())[0, 1]
    assert abs(correlation) < 5 / np.sqrt(one.size)
    again = NoiseBank(5, (400, 600), 2.0).expose(flat, "a")
    assert np.array_equal(again, one)
    assert not np.array_equal(NoiseBank(6, (400, 600), 2.0).expose(flat, "a"), one)


def test_bright_light_saturates():
    bank = NoiseBank(5, (40, 60), 2.0)
    assert (bank.expose(np.full((40, 60), 400.0, dtype=np.float32), "x") == 255).all()


def test_the_room_is_uneven_by_its_share_and_has_one_glare_spot(truth, optics):
    signal = optics.expose(still(AWAY))
    smooth = cv2.GaussianBlur(signal, (0, 0), 12)
    table = smooth[smooth > 0.4 * np.median(smooth)]
    low, high = np.percentile(table, [0.1, 95])
    assert 0.65 < low / high < 0.85
    _, bright = cv2.threshold(signal, 1.5 * np.percentile(signal, 95), 255, cv2.THRESH_BINARY)
    assert cv2.connectedComponents(bright.astype(np.uint8))[0] - 1 == 1


def test_projected_light_falls_where_the_truth_says(truth, optics):
    image = np.zeros((1080, 1920), dtype=np.uint8)
    image[500:540, 900:960] = 255
    gain = optics.expose(still(AWAY, showing(image))) - optics.expose(still(AWAY))
    rows, columns = np.indices(gain.shape)
    centre = np.array([(gain * columns).sum(), (gain * rows).sum()]) / gain.sum()
    corners = np.array([[899.5, 499.5], [959.5, 499.5], [959.5, 539.5], [899.5, 539.5]])
    expected = truth.camera.project(truth.light_lands(corners)).mean(axis=0)
    assert np.linalg.norm(centre - expected) < 0.05


def test_the_projector_s_light_follows_the_board_up(truth, optics):
    """A dot lands on a raised board where the projector's ray meets the board, not the table."""
    flange = flange_showing(truth, "markers", 0.5, (0.1, 0, 0.4), (960, 540))
    board = truth.boards["markers"]
    plane = flange @ board.pose.matrix
    place = plane @ (*(board.centre - (0.0, 0.5 * CR.boards.pitch_m)), 0.0, 1.0)
    u, v = truth.projector.project(place[:3]).round().astype(int)
    image = np.zeros((1080, 1920), dtype=np.uint8)
    cv2.circle(image, (int(u), int(v)), 12, 255, -1)
    frames = frames_with_flange(flange)
    gain = optics.expose(still(frames, showing(image))) - optics.expose(still(frames))
    spot = np.array(np.unravel_index(cv2.GaussianBlur(gain, (0, 0), 4).argmax(), gain.shape)[::-1])
    assert np.linalg.norm(spot - truth.camera.project(place[:3])) < 8
    on_table = truth.camera.project(truth.light_lands(np.array([[u, v]], dtype=float)))[0]
    assert np.linalg.norm(spot - on_table) > 30
    row, column = on_table.round().astype(int)[::-1]
    assert gain[row, column] < 1  # and it is gone from the table


def test_boards_shade_the_table(truth, optics):
    """Behind a raised board, as the projector sees it, no projected light is left."""
    flange = flange_showing(truth, "markers", 0.45, (0, 0, 0), (960, 1000))
    frames = frames_with_flange(flange)
    states = (AWAY, DARK), (AWAY, showing(WHITE)), (frames, DARK), (frames, showing(WHITE))
    bare, lit, dark, shaded = (optics.expose(still(f, light)) for f, light in states)
    tray = next(b.shape for b in bodies(truth) if b.name == "tray" and isinstance(b.shape, Plate))
    inner = Plate(tray.pose, tray.centre, tray.half * 0.95)
    lamp, found = truth.projector.pose.translation, 0
    for place in plate_points(inner, 0.01) @ flange[:3, :3].T + flange[:3, 3]:
        hidden = truth.table.hit(lamp, (place - lamp)[None])[0]
        column, row = truth.camera.project(hidden).round().astype(int)
        if not (0 <= column < WIDTH and 0 <= row < HEIGHT):
            continue
        seen = np.isclose(dark[row, column], bare[row, column])  # the table, past the bracket
        if seen and lit[row, column] - bare[row, column] > 50:
            found += 1
            assert shaded[row, column] == pytest.approx(bare[row, column], abs=1)
    assert found > 10


def test_the_arm_occludes_what_is_behind_it(truth, optics):
    joints = np.radians([-76.0, -84, -111, -75, 90, -166])
    frames = truth.arm.link_frames(joints)
    bare, armed = (optics.expose(still(f)) for f in (AWAY, frames))
    wrist = truth.camera.project(frames[5, :3, 3]).round().astype(int)
    assert abs(armed[wrist[1], wrist[0]] - bare[wrist[1], wrist[0]]) > 15
    untouched = np.abs(armed - bare) < 1e-3
    assert 0.3 < untouched.mean() < 0.95


def test_an_exposure_over_two_pictures_is_their_mixture(optics):
    other = np.zeros_like(WHITE)
    other[:, :960] = 255
    one, two = Picture(WHITE), Picture(other)
    mixed = optics.expose(still(AWAY, ((0.25, one), (0.75, two))))
    pure = [optics.expose(still(AWAY, ((1.0, p),))) for p in (one, two)]
    assert np.abs(mixed - (0.25 * pure[0] + 0.75 * pure[1])).max() < 0.05


def test_an_exposure_over_a_motion_is_blurred(truth, optics):
    flanges = [
        flange_showing(truth, "checkerboard", 0.5, (0, 0, 0), (960 + 3 * i, 540)) for i in range(8)
    ]
    moving = optics.expose(
        tuple(Instant(1 / 8, frames_with_flange(f), ((1.0, None),)) for f in flanges)
    )
    sharp = optics.expose(still(frames_with_flange(flanges[4])))
    middle = np.s_[440:640, 860:1060]
    across = [np.abs(np.diff(p[middle], axis=1)).max() for p in (moving, sharp)]
    along = [np.abs(np.diff(p[middle], axis=0)).max() for p in (moving, sharp)]
    assert across[0] < 0.4 * across[1]  # blurred along the motion,
    assert along[0] > 0.8 * along[1]  # sharp across it


def test_caching_changes_nothing(truth):
    flange = flange_showing(truth, "markers", 0.6, (0.2, 0.1, 0), (900, 500))
    states = [still(AWAY, showing(WHITE)), still(frames_with_flange(flange), showing(WHITE))]
    used = Optics(truth)
    for state in (*states, *states):
        used.expose(state)
    for state in states:
        assert np.array_equal(used.expose(state), Optics(truth).expose(state))


def test_a_renderer_follows_a_nudged_camera(truth):
    nudge = Transform("camera", "camera", pose_matrix((0, 0, 0.02), (0, 0, 0)))
    nudged = replace(truth, camera=replace(truth.camera, pose=truth.camera.pose @ nudge))
    renderer = Renderer(SEED, CR.camera)
    first, second, third = (renderer.picture(t, still(AWAY), "n") for t in (truth, nudged, truth))
    assert np.array_equal(first, third)
    assert not np.array_equal(first, second)


def test_any_pose_can_be_rendered(truth, optics):
    """Boards edge-on, behind the camera, through its plane, larger than the picture."""
    rng = np.random.default_rng(4)
    for _ in range(60):
        place = truth.camera.pose.translation + rng.normal(size=3) * 0.4
        flange = pose_matrix(rng.normal(size=3) * 3, place)
        light = showing(WHITE) if rng.random() < 0.3 else ((1.0, None),)
        signal = optics.expose(still(frames_with_flange(flange), light))
        assert np.isfinite(signal).all()
        assert signal.min() >= -1e-3
