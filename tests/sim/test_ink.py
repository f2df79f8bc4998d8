"""Ink in pictures: where it is, how dark, and what of it a picture may show."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from cellctl.sim import mishaps
from cellctl.sim.optics import Optics, Renderer
from cellctl.sim.paper import Line, printed
from cellctl.sim.presets import CR
from cellctl.sim.truth import draw
from tests.sim.scenes import AWAY, showing, still
from tests.sim.strokes import at_work, draw_circle, lines_of

INK_ALBEDO = 0.08
WIDTH_M = 0.8e-3
WHITE = np.full((1080, 1920), 255, dtype=np.uint8)


@pytest.fixture(scope="module")
def truth():
    return draw(CR, 3)


@pytest.fixture(scope="module")
def optics(truth):
    return Optics(truth)


@pytest.fixture(scope="module")
def blank(optics):
    return optics.expose(still(AWAY)).astype(float)


def ring(centre, radius, count=1500):
    angle = np.linspace(0.0, 2 * np.pi, count)
    return centre + radius * np.column_stack([np.cos(angle), np.sin(angle)])


NUMBERS = itertools.count()


def line(places, sheet=0):
    t = np.linspace(0.0, 1.0, len(places))
    return Line(next(NUMBERS), sheet, None, WIDTH_M, t, places)


def whole(*lines):
    return tuple((one, len(one.t)) for one in lines)


def pixels_of(truth, places):
    return truth.camera.project(truth.table.surface(truth.sheets[0].on_table(places)))


def moments(polygon):
    """Area and area times centroid of a polygon (n, 2)."""
    (x, y), (nx, ny) = polygon.T, np.roll(polygon, -1, axis=0).T
    cross = x * ny - nx * y
    return cross.sum() / 2, np.array([((x + nx) * cross).sum(), ((y + ny) * cross).sum()]) / 6


def seen_band(truth, centre, radius):
    """Area (pixels) and centroid of a circle of the pen's width, projected exactly."""
    outer, inner = (
        moments(pixels_of(truth, ring(centre, radius + side * WIDTH_M / 2)[:-1]))
        for side in (1, -1)
    )
    area = outer[0] - inner[0]
    return abs(area), (outer[1] - inner[1]) / area


def measured(signal, blank):
    """Area (pixels) and centroid of what is darker than the blank sheet."""
    cover = (1 - signal / blank) / (1 - INK_ALBEDO)
    cover[np.abs(cover) < 1e-5] = 0
    rows, columns = np.nonzero(cover)
    weight = cover[rows, columns]
    return weight.sum(), np.array([weight @ columns, weight @ rows]) / weight.sum()


def test_circles_are_where_the_lens_sees_them_to_a_hundredth_of_a_pixel(truth, optics, blank):
    rng, errors, areas = np.random.default_rng(0), [], []
    for _ in range(20):
        centre = rng.uniform(-0.9, 0.9, 2) * (truth.sheets[0].half - 0.03)
        radius = rng.uniform(0.008, 0.025)
        ink = whole(line(ring(centre, radius)))
        area, place = measured(optics.expose(still(AWAY), ink), blank)
        true_area, true_place = seen_band(truth, centre, radius)
        errors.append(place - true_place)
        areas.append(area / true_area)
    assert np.abs(errors).max() < 0.01
    assert np.abs(np.mean(errors, axis=0)).max() < 0.002
    assert areas == pytest.approx([1.0] * len(areas), abs=0.005)


def test_what_was_drawn_is_seen_where_it_is(truth):
    world = at_work(truth)
    draw_circle(world)
    places = max(lines_of(world, 0), key=len)
    optics = Optics(truth)
    blank = optics.expose(still(AWAY)).astype(float)
    _, place = measured(optics.expose(still(AWAY), world.arm.pen.ink(world.now)), blank)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    middles = truth.camera.project(truth.table.surface((places[1:] + places[:-1]) / 2))
    assert np.linalg.norm(place - steps @ middles / steps.sum()) < 0.05  # its ends overlap


def test_a_broad_mark_is_as_dark_as_ink_in_any_light(truth, optics):
    black = replace(line(ring(np.zeros(2), 0.001)), width=0.03)
    column, row = pixels_of(truth, np.zeros((1, 2)))[0].astype(int)
    for light in (still(AWAY), still(AWAY, showing(WHITE))):
        bare = optics.expose(light)[row, column]
        assert optics.expose(light, whole(black))[row, column] == pytest.approx(
            INK_ALBEDO * bare, rel=1e-3
        )


def test_the_line_is_blurred_as_the_lens_blurs(truth, optics, blank):
    """Across a long straight line, the second moment is that of band, pixel and defocus."""
    at = np.column_stack([np.linspace(-0.2, 0.2, 3000), np.zeros(3000)])
    signal = optics.expose(still(AWAY), whole(line(at)))
    a, b = pixels_of(truth, at[[0, -1]])
    normal = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    cover = 1 - signal / blank
    rows, columns = np.nonzero(cover > 1e-5)
    inner = (columns > a[0] + 20) & (columns < b[0] - 20)
    rows, columns = rows[inner], columns[inner]
    curve = pixels_of(truth, at)
    middle = np.interp(columns, curve[:, 0], curve[:, 1])
    across, weight = (rows - middle) * normal[1], cover[rows, columns]
    width = WIDTH_M * np.linalg.norm(b - a) / 0.4
    variance = weight @ across**2 / weight.sum()
    assert abs(weight @ across / weight.sum()) < 0.003
    assert variance == pytest.approx(0.7**2 + (width**2 + 1) / 12, rel=0.03)


def test_pictures_that_were_taken_before_change_nothing(truth):
    one, two = line(ring(np.zeros(2), 0.02)), line(ring(np.array([0.02, 0.0]), 0.02))
    lit = showing(WHITE)
    used = Optics(truth)
    for ink in ((), ((one, 400),), ((one, 900),), whole(one), whole(one, two), whole(one)):
        for light in (still(AWAY), still(AWAY, lit)):
            fresh = Optics(truth).expose(light, ink)
            assert np.array_equal(used.expose(light, ink), fresh)
            assert np.array_equal(used.expose(light, ink), fresh)


def test_a_line_over_a_line_is_no_blacker(truth, optics):
    one = line(ring(np.zeros(2), 0.02))
    again = replace(one, number=next(NUMBERS))
    once = optics.expose(still(AWAY), whole(one))
    assert np.array_equal(optics.expose(still(AWAY), whole(one, again)), once)


def test_ink_of_sheets_that_lie_elsewhere_is_not_seen(truth, optics):
    gone = line(ring(np.zeros(2), 0.02), sheet=7)
    assert np.array_equal(optics.expose(still(AWAY), whole(gone)), optics.expose(still(AWAY)))


def test_lines_may_leave_the_picture(truth, optics):
    for places in (ring(np.array([0.37, 0.22]), 0.9), ring(np.array([9.0, 9.0]), 0.1)):
        assert np.isfinite(optics.expose(still(AWAY), whole(line(places)))).all()


def test_a_moved_sheet_is_seen_elsewhere_and_its_edge_is_a_step(truth):
    moved = truth.sheets[0].moved(np.array([0.03, 0.0]), 0.0)
    before, after = (
        Optics(t).expose(still(AWAY)) for t in (truth, replace(truth, sheets=(moved,)))
    )
    change = after - before
    for side, brighter in ((1, True), (-1, False)):
        middle = truth.sheets[0].on_table(np.array([[side * 0.375 + 0.015, 0.0]]))
        column, row = truth.camera.project(truth.table.surface(middle))[0].astype(int)
        step = change[row - 5 : row + 5, column - 5 : column + 5].mean()
        assert 1.0 < (step if brighter else -step) < 8.0
    world = at_work(truth)
    draw_circle(world)
    ink = world.arm.pen.ink(world.now)
    places = []
    for sheet in (truth.sheets[0], moved):
        optics = Optics(replace(truth, sheets=(sheet,)))
        bare = optics.expose(still(AWAY)).astype(float)
        places.append(measured(optics.expose(still(AWAY), ink), bare)[1])
    shift = np.linalg.norm(places[1] - places[0])
    assert shift == pytest.approx(0.03 * truth.camera.lens.focal.mean() / 0.8, rel=0.02)


def test_a_form_shows_its_print(truth):
    world = at_work(truth)
    mishaps.print_sheet(world, "A")
    ink = world.arm.pen.ink(world.now)
    assert len(ink) == len(printed(truth.sheets[0]))
    bare, form = (Optics(t).expose(still(AWAY), i) for t, i in ((truth, ()), (world.truth, ink)))
    darker = (form < 0.8 * bare).mean()
    assert 0.002 < darker < 0.05


def test_a_picture_shows_the_ink_of_its_time(truth):
    world = at_work(truth)
    renderer = Renderer(truth.seed, CR.camera)
    while world.dequeue():
        pass
    before = world.now
    draw_circle(world)
    seen: dict[float, int] = {}
    while world.now < before + 30 and len(seen) < 6:
        frame = world.dequeue()
        if frame is None:
            world.advance(max(world.now, world.stream.ready_at()))
            continue
        seen[frame.capture.t] = sum(count for _, count in frame.ink)
    assert seen[min(seen)] == 0  # exposed before, dequeued after
    assert seen[max(seen)] > 100
    last = world.arm.pen.ink(world.now)
    picture = renderer.picture(truth, still(AWAY), "a", last)
    assert np.array_equal(picture, renderer.picture(truth, still(AWAY), "a", last))
    assert not np.array_equal(picture, renderer.picture(truth, still(AWAY), "a"))
