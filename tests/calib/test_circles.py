"""Drawn circles found in pictures of awkward sheets: where they are, and when they are not."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cellctl.calib.camera import CameraModel
from cellctl.calib.circles import Circle, Expected, find_circles
from cellctl.calib.printed import Unseen
from cellctl.errors import BadInput, CellctlError, SolveError
from cellctl.geometry import Array, pose_matrix
from tests.calib.ink import CR, IR, Block, Light, Ring, Sheet, Stroke, above, noisy

R, LINE = 0.010, 0.0008
"""A circle of the small cell, metres."""
SMALL = CameraModel(
    np.array([[915.0, 0.0, 318.0], [0.0, 914.0, 242.0], [0.0, 0.0, 1.0]]),
    np.array([0.085, -0.060, 0.0005, -0.0004, 0.012]),
    (640, 480),
)
"""A part of the small cell's picture: 0.55 x 0.41 m of the table."""
SHEET = Sheet(SMALL, above(0.8))


def spots(counts: tuple[int, int], pitch: float, jitter: float = 0.0, seed: int = 0) -> Array:
    """Places (n, 2) of a grid about the origin."""
    columns, rows = ((np.arange(n) - (n - 1) / 2) * pitch for n in counts)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return grid + np.random.default_rng(seed).uniform(-jitter, jitter, grid.shape)


def rings(places: Array, radius: float = R, line: float = LINE, **more: Any) -> list[Ring]:
    return [Ring(float(x), float(y), radius, line, **more) for x, y in places]


def wanted(places: Array, radius: float = R) -> list[Expected]:
    return [Expected(f"c{i:02d}", place, radius) for i, place in enumerate(places)]


def find(image: Any, expected: list[Expected], sheet: Sheet = SHEET, **more: Any) -> Any:
    options = {"search_m": 0.012, "line_m": LINE} | more
    return find_circles(image, sheet.camera, sheet.T, expected, **options)


def errors(found: Any, places: Array, sheet: Sheet = SHEET) -> Array:
    """(n, 2) px; fails when a circle was not seen."""
    unseen = {key: value.reason for key, value in found.items() if isinstance(value, Unseen)}
    assert not unseen
    return np.array([circle.centre_px for circle in found.values()]) - sheet.project(places)


def rms(errors: Array) -> float:
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def lettering(low: tuple[float, float], high: tuple[float, float], seed: int = 0) -> list[Any]:
    """Print that fills a box: words of strokes and small bows, 3 mm high."""
    rng = np.random.default_rng(seed)
    things: list[Any] = []
    for y in np.arange(low[1], high[1], 0.008):
        for x in np.arange(low[0], high[0], 0.003):
            if rng.random() < 0.2:
                continue
            if rng.random() < 0.3:
                things.append(Ring(x, y, 0.001, 0.0004, start=rng.uniform(0, 360), sweep=270.0))
            a, b = rng.uniform((x, y), (x + 0.002, y + 0.003), (2, 2))
            things.append(Stroke(tuple(a), tuple(b + 1e-5), 0.0004))
    return things


@pytest.mark.parametrize(
    ("camera", "distance", "pitch", "radius", "line", "limit_s"),
    [(CR, 0.8, 0.042, 0.010, 0.0008, 0.5), (IR, 4.0, 0.12, 0.025, 0.0018, 1.5)],
    ids=["cr", "ir"],
)
def test_centres_are_where_they_are(camera, distance, pitch, radius, line, limit_s):
    """72 circles, all 8 mm off: accuracy, predicted sigma, and the processor's time."""
    sheet = Sheet(camera, above(distance))
    places = spots((9, 8), pitch, 0.004)
    image = sheet.picture(rings(places, radius, line))
    expected = wanted(places - (0.006, 0.005), radius)
    started = time.process_time()
    found = find(image, expected, sheet, line_m=line, search_m=0.015)
    took = time.process_time() - started
    off = errors(found, places, sheet)
    assert rms(off) < 0.01
    assert np.abs(off.mean(axis=0)).max() < 0.003
    predicted = np.array([circle.sigma_px for circle in found.values()])
    assert 0.6 < rms(off) / np.sqrt(2.0) / np.sqrt(np.mean(predicted**2)) < 1.5
    for circle in found.values():
        assert np.allclose(camera.pixels(camera.plane(circle.centre_px)), circle.centre_px)
        assert np.allclose(camera.normalise(circle.centre_px), circle.xy)
        assert circle.radius_m == pytest.approx(radius, rel=0.006)
        assert circle.seen > 0.98
    assert took < limit_s


@pytest.mark.parametrize("azimuth", [0.0, 30.0, 140.0])
def test_perspective_does_not_shift_centres(azimuth):
    """Seen at 30 degrees, a circle of 25 mm has its ellipse's centre 0.4 px off its own."""
    sheet = Sheet(CR, above(0.8, 30.0, azimuth))
    places = spots((5, 3), 0.08, 0.01)
    image = sheet.picture(rings(places, 0.025), noise=0.0)
    off = errors(find(image, wanted(places, 0.025), sheet), places, sheet)
    assert np.abs(off.mean(axis=0)).max() < 0.003
    assert np.linalg.norm(off, axis=1).max() < 0.015


@pytest.mark.parametrize("jitter", [0.0, 0.002])
def test_all_off_alike_by_half_of_a_pitch(jitter):
    """Spots 30 mm apart, all 15 mm off: each circle is as near to its neighbour's place."""
    places = spots((8, 6), 0.030, jitter)
    image = SHEET.picture(rings(places))
    found = find(image, wanted(places - (0.0150, 0.0)), search_m=0.022)
    assert rms(errors(found, places)) < 0.02


def test_turned_and_stretched_all_together():
    places = spots((8, 6), 0.035, 0.003)
    turn = np.array([[1.02, -0.07], [0.07, 0.98]])
    image = SHEET.picture(rings(places))
    found = find(image, wanted(places @ turn.T + 0.004), search_m=0.02)
    assert rms(errors(found, places)) < 0.02


def test_some_slipped():
    """From one round on the pen sits 3 mm off: those are found where they are."""
    places = spots((8, 6), 0.035, 0.003)
    commanded = places.copy()
    commanded[24:] += (0.003, 0.0)
    found = find(SHEET.picture(rings(places)), wanted(commanded))
    assert rms(errors(found, places)) < 0.02


def test_neighbours_do_not_stand_in_for_missing_ones():
    places = spots((6, 5), 0.030)
    missing = [3, 7, 8, 14, 29]
    drawn = np.delete(places, missing, axis=0)
    image = SHEET.picture(rings(drawn))
    found = find(image, wanted(places - (0.009, 0.004)), search_m=0.028)
    gone = [i for i, value in enumerate(found.values()) if isinstance(value, Unseen)]
    assert gone == missing
    assert all(list(found.values())[i].reason.startswith("no ink") for i in missing)
    left = {key: value for key, value in found.items() if isinstance(value, Circle)}
    assert rms(errors(left, drawn)) < 0.02


def clutter(places: Array) -> list[Any]:
    """Light and print about circles: rings of light around and across them, lit markers, ruled
    lines across, lettering, printed circles, old ink."""
    things: list[Any] = []
    for i, (x, y) in enumerate(places):
        things.append(Ring(x, y, 0.015, 0.0015, ink=-0.5))
        if i % 3 == 0:
            things.append(Ring(x + 0.013, y + 0.004, 0.012, 0.0012, ink=-0.4))
        if i % 4 == 0:
            things.append(Block((x - 0.03, y - 0.02), (x - 0.011, y - 0.004), ink=-0.4))
        if i % 5 == 0:
            things.append(Stroke((x - 0.03, y + 0.004), (x + 0.03, y + 0.001), 0.0006))
        if i % 6 == 1:
            things.append(Ring(x + 0.001, y - 0.002, 0.0062, 0.0006))
        if i % 6 == 2:
            things.append(Ring(x + 0.019, y - 0.004, R, LINE, start=40.0, sweep=200.0))
        if i % 6 == 4:
            things += lettering((x - 0.008, y + 0.0125), (x + 0.012, y + 0.02), seed=i)
    return things


def test_among_light_print_and_old_ink():
    places = spots((7, 5), 0.055, 0.003)
    sheet = replace(SHEET, light=Light(glare=90.0, at=(0.05, 0.02), radius=0.04))
    image = sheet.picture([*rings(places), *clutter(places)])
    off = errors(find(image, wanted(places - (0.004, -0.003))), places)
    assert rms(off) < 0.05
    assert np.linalg.norm(off, axis=1).max() < 0.12


def test_nothing_is_found_where_nothing_was_drawn():
    """Print, text, light and glare, but no circle of about that radius."""
    places = spots((7, 5), 0.055, 0.003)
    things: list[Any] = [Ring(x, y, 0.015, 0.0015, ink=-0.5) for x, y in places]
    things += lettering((-0.16, -0.06), (-0.1, 0.06))
    things += [Block((x + 0.01, y), (x + 0.016, y + 0.006)) for x, y in places]
    things += [Ring(x, y, 0.024, LINE) for x, y in places[::3]]
    things += [Stroke((-0.05, y), (0.06, y), 0.0005) for y in np.arange(-0.1, 0.1, 0.007)]
    sheet = replace(SHEET, light=Light(glare=160.0, at=(0.1, 0.05), radius=0.05))
    clean = sheet.clean(things)
    for seed in range(3):
        found = find(noisy(clean, seed), wanted(places), search_m=0.02)
        assert all(isinstance(value, Unseen) for value in found.values())


@pytest.mark.parametrize("strength", [60.0, 100.0, 160.0])
def test_glare_on_a_part(strength):
    """What glare leaves of a circle is enough, or it is said that glare hides it."""
    sheet = replace(SHEET, light=Light(glare=strength, at=(0.007, 0.004), radius=0.006))
    place = np.zeros((1, 2))
    answer = find(sheet.picture(rings(place)), wanted(place))["c00"]
    if isinstance(answer, Unseen):
        assert "glare" in answer.reason
    else:
        assert np.linalg.norm(answer.centre_px - SHEET.project(place[0])) < 0.05


def test_too_much_glare():
    sheet = replace(SHEET, light=Light(glare=250.0, at=(0.004, 0.0), radius=0.012))
    answer = find(sheet.picture(rings(np.zeros((1, 2)))), wanted(np.zeros((1, 2))))["c00"]
    assert isinstance(answer, Unseen)


@pytest.mark.parametrize("share", [0.45, 0.55, 0.7, 0.8])
def test_half_drawn(share):
    places = spots((5, 4), 0.05, 0.003)
    drawn = [
        replace(ring, start=37.0 * i, sweep=360.0 * share if i % 2 else 360.0)
        for i, ring in enumerate(rings(places))
    ]
    found = find(SHEET.picture(drawn), wanted(places - 0.003))
    for i, answer in enumerate(found.values()):
        assert isinstance(answer, Unseen if i % 2 else Circle)
        if isinstance(answer, Unseen):
            stated = int(answer.reason.removeprefix("half drawn: ink on ").split(" %")[0])
            assert abs(stated - 100 * share) < 6


def test_a_short_gap_does_no_harm():
    places = spots((5, 4), 0.05, 0.003)
    drawn = [replace(ring, start=37.0 * i, sweep=335.0) for i, ring in enumerate(rings(places))]
    assert rms(errors(find(SHEET.picture(drawn), wanted(places)), places)) < 0.02


def test_another_radius_is_told():
    places = spots((5, 4), 0.05, 0.003)
    drawn = [replace(ring, radius=0.0081) for ring in rings(places)]
    found = find(SHEET.picture(drawn), wanted(places))
    assert rms(errors(found, places)) < 0.02
    assert [c.radius_m for c in found.values()] == pytest.approx([0.0081] * 20, rel=0.01)


def test_the_right_radius_is_preferred():
    """Printed circles about the same centre, next to the drawn one."""
    places = spots((5, 4), 0.05, 0.003)
    printed = rings(places + 0.0004, 0.0062) + rings(places, 0.0135)
    found = find(SHEET.picture(rings(places) + printed), wanted(places - 0.004))
    assert [c.radius_m for c in found.values()] == pytest.approx([R] * 20, rel=0.01)
    assert rms(errors(found, places)) < 0.05


def test_an_old_whole_circle_does_not_stand_in_for_a_half_one():
    places = spots((5, 4), 0.05, 0.003)
    drawn = rings(places)
    drawn[7] = replace(drawn[7], sweep=200.0)
    old = Ring(places[7, 0] + 0.005, places[7, 1] - 0.024, R, LINE)
    found = find(SHEET.picture([*drawn, old]), wanted(places - 0.006), search_m=0.03)
    assert isinstance(found["c07"], Unseen)
    assert found["c07"].reason.startswith("half drawn")


def test_what_was_there_before_does_not_count():
    places = spots((5, 4), 0.05, 0.003)
    there: list[Any] = [*rings(places[::2] + 0.002), *lettering((-0.03, -0.03), (0.03, 0.03))]
    clean = SHEET.clean(there)
    before = noisy(clean, 1)
    same = find(noisy(clean, 2), wanted(places), before=before)
    assert all(isinstance(value, Unseen) for value in same.values())
    drawn = SHEET.picture([*there, *rings(places)], seed=3)
    assert rms(errors(find(drawn, wanted(places), before=before), places)) < 0.1


def test_rings_of_light():
    places = spots((5, 4), 0.05, 0.003)
    shown = [replace(ring, ink=-0.5) for ring in rings(places, 0.014, 0.0015)]
    image = SHEET.picture([*rings(places), *shown])
    found = find(image, wanted(places, 0.014), polarity="bright", line_m=0.0015)
    assert rms(errors(found, places)) < 0.03
    assert min(circle.contrast for circle in found.values()) > 20
    dark = find(image, wanted(places), search_m=0.02)
    assert rms(errors(dark, places)) < 0.03


@pytest.mark.parametrize(("ink", "line"), [(0.12, 0.0008), (0.3, 0.0015), (0.9, 0.0015)])
def test_pale_and_wide_lines(ink, line):
    places = spots((5, 4), 0.05, 0.003)
    found = find(SHEET.picture(rings(places, R, line, ink=ink)), wanted(places))
    assert rms(errors(found, places)) < 0.05


def test_pictures_of_any_kind_are_the_same():
    places = spots((3, 2), 0.05, 0.003)
    image = SHEET.picture(rings(places))
    grey = find(image, wanted(places))
    for other in (np.repeat(image[..., None], 3, axis=2), image.astype(np.float32)):
        for key, circle in find(other, wanted(places)).items():
            assert np.allclose(circle.centre_px, grey[key].centre_px, atol=1e-3)


def test_outside_the_picture():
    expected = wanted(np.array([[0.0, 0.0], [3.0, 0.0]]))
    found = find(SHEET.picture(rings(np.zeros((1, 2)))), expected)
    assert isinstance(found["c00"], Circle)
    assert isinstance(found["c01"], Unseen)
    assert "outside the picture" in found["c01"].reason


BLANK = np.full((480, 640), 190, np.uint8)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"image": np.zeros((0, 0), np.uint8)}, "640x480"),
        ({"image": BLANK.astype(np.int32)}, "uint8"),
        ({"image": "picture.png"}, "str"),
        ({"image": BLANK[None]}, "grey"),
        ({"image": np.full((480, 640), np.nan, np.float32)}, "not finite"),
        ({"before": BLANK[:-1]}, "before"),
        ({"search_m": 0.0}, "search_m"),
        ({"line_m": float("nan")}, "line_m"),
        ({"line_m": 0.02}, "wider than its radius"),
        ({"polarity": "grey"}, "polarity"),
        ({"T_camera_plane": np.eye(3)}, "T_camera_plane"),
        ({"T_camera_plane": "above"}, "T_camera_plane"),
        ({"T_camera_plane": np.full((4, 4), np.nan)}, "T_camera_plane"),
        ({"expected": [Expected("a", (0.0, np.inf), R)]}, "'a'"),
        ({"expected": [Expected("a", (0.0, 0.0, 0.0), R)]}, "'a'"),
        ({"expected": [Expected("a", (0.0, 0.0), -R)]}, "'a'"),
        ({"expected": [Expected("a", (0.0, 0.0), R)] * 2}, "same key"),
    ],
)
def test_bad_input_is_named(change, words):
    given_ = {
        "image": BLANK,
        "camera": SMALL,
        "T_camera_plane": SHEET.T,
        "expected": wanted(np.zeros((1, 2))),
        "search_m": 0.01,
        "line_m": LINE,
    } | change
    with pytest.raises(BadInput, match=words):
        find_circles(**given_)


@pytest.mark.parametrize("height", [-0.8, 0.0])
def test_a_plane_that_the_camera_does_not_look_at(height):
    T = SHEET.T.copy()
    T[:3, 3] = (0.0, 0.0, height)
    with pytest.raises(SolveError, match=r"behind the camera|stands in the plane"):
        find_circles(BLANK, SMALL, T, wanted(np.zeros((1, 2))), search_m=0.01, line_m=LINE)


def test_circles_too_small_to_see():
    with pytest.raises(SolveError, match="too small to be found"):
        find(BLANK, wanted(np.zeros((1, 2)), 0.002))


def test_at_the_pictures_edge():
    """A circle that leaves the picture by a fifth is found; one that leaves by half is not."""
    columns = SMALL.image_size[0]
    x = np.linspace(0.2, 0.35, 3001)
    at = np.interp(
        [columns - 1 - 7.0, columns - 1 - 1.0],
        SHEET.project(np.stack([x, np.zeros_like(x)], axis=-1))[:, 0],
        x,
    )
    for place, kind in zip(at, (Circle, Unseen), strict=True):
        places = np.array([[place, 0.0]])
        found = find(SHEET.picture(rings(places)), wanted(places))
        assert isinstance(found["c00"], kind)


@pytest.mark.parametrize("blur", [0.5, 1.2, 1.8])
def test_in_and_out_of_focus(blur):
    sheet = replace(SHEET, blur=blur)
    places = spots((6, 5), 0.04, 0.003)
    assert rms(errors(find(sheet.picture(rings(places)), wanted(places - 0.003)), places)) < 0.02


def test_a_tilt_that_is_wrong_by_five_degrees():
    places = spots((6, 5), 0.04, 0.003)
    image = SHEET.picture(rings(places))
    wrong = replace(SHEET, T=SHEET.T @ pose_matrix((np.radians(5.0), 0.0, 0.0), np.zeros(3)))
    found = find(image, wanted(places), wrong)
    assert rms(errors(found, places)) < 0.05


TINY = CameraModel(
    np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]), np.zeros(5), (64, 48)
)


@settings(max_examples=60)
@given(
    image=hnp.arrays(np.uint8, (48, 64), elements=st.sampled_from([0, 60, 180, 190, 255])),
    tilt=st.floats(0.0, 50.0),
    centres=st.lists(st.tuples(*[st.floats(-0.6, 0.6)] * 2), min_size=1, max_size=5),
    radius=st.floats(0.12, 0.4),
    search=st.floats(0.001, 1.0),
    before=st.booleans(),
)
def test_whatever_is_in_the_picture(image, tilt, centres, radius, search, before):
    """Every expected circle is answered, and what is seen is near where it was expected."""
    found = find_circles(
        image,
        TINY,
        above(1.0, tilt),
        [Expected(str(i), centre, radius) for i, centre in enumerate(centres)],
        search_m=search,
        line_m=0.02,
        before=np.roll(image, 3) if before else None,
    )
    assert list(found) == [str(i) for i in range(len(centres))]
    for answer, centre in zip(found.values(), centres, strict=True):
        if isinstance(answer, Circle):
            assert np.linalg.norm(answer.place - centre) <= search
            assert np.isfinite([*answer.centre_px, *answer.xy, answer.sigma_px]).all()
            assert 0.45 < answer.radius_m / radius < 1.55


NUMBERS = st.floats(-3.0, 3.0) | st.sampled_from([float("nan"), float("inf"), 1e300, -1e-300])


@settings(max_examples=40)
@given(
    image=hnp.arrays(np.uint8, (48, 64)),
    pose=st.tuples(*[NUMBERS] * 6),
    centres=st.lists(st.tuples(NUMBERS, NUMBERS), max_size=4),
    sizes=st.tuples(*[st.floats(1e-5, 1.0) | NUMBERS] * 3),
    polarity=st.sampled_from(["dark", "bright"]),
)
def test_whatever_comes_is_answered_or_refused(image, pose, centres, sizes, polarity):
    """Noise for a picture, any pose and any expectation: each key is answered, or an error of
    ours says why not."""
    radius, search, line = sizes
    expected = [Expected(str(i), centre, radius) for i, centre in enumerate(centres)]
    try:
        found = find_circles(
            image,
            TINY,
            pose_matrix(np.nan_to_num(pose[:3]), pose[3:]),
            expected,
            search_m=search,
            line_m=line,
            polarity=polarity,
        )
    except CellctlError:
        return
    assert list(found) == [item.key for item in expected]
