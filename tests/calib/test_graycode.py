"""Gray code: what is shown, in which order, and how it is read back from pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.calib.graycode import BLACK, KEYS, SECTIONS, WHITE, GrayCode, code_from
from cellctl.calib.graycode_decode import Decoded, decode
from cellctl.calib.graycode_local import at_places
from cellctl.errors import BadInput, SolveError
from tests.calib.lit import BOARD, POSES, Scene

SIZE = (320, 240)
OPENCV = (
    "cv2.structured_light.GrayCodePattern: column bits MSB first, each followed by its inverse, "
    "then row bits, then white, black"
)


@pytest.mark.parametrize("size", [(1024, 768), (1280, 800), (33, 20)])
def test_opencv_shows_the_same(size):
    theirs = cv2.structured_light.GrayCodePattern.create(*size).generate()[1]
    code = GrayCode.of(size)
    assert code_from(None, size, "x") == code_from(OPENCV, size, "x") == code
    assert code.slides[-2:] == (WHITE, BLACK)
    assert len(code.slides) == len(theirs) + 2
    for slide, picture in zip(code.slides, theirs, strict=False):
        assert np.array_equal(code.picture(slide), picture)


def test_orders_that_people_write():
    text = "black, white, then row bits LSB first, then column bits (no inverse)"
    code = code_from(text, SIZE, "x")
    assert code.slides[:2] == (BLACK, WHITE)
    assert [(s.shows, s.bit) for s in code.slides[2:4]] == [("row", 0), ("row", 1)]
    assert not code.inverses
    as_object = {"order": ["black", "white", "rows", "columns"], "first_bit": "lsb"}
    assert code_from({**as_object, "inverses": False}, SIZE, "x") == code
    fewer = code_from({"column_bits": 6, "row_bits": 5, "offset": [96, 8]}, SIZE, "x")
    assert fewer.bits("column") == [8, 7, 6, 5, 4, 3]
    assert len(fewer.slides) == 2 * 11 + 2


@pytest.mark.parametrize(
    ("value", "word"),
    [
        ("some Gray code", "cannot tell"),
        ("columns MSB first or LSB first, rows, white, black", "cannot tell"),
        ({"order": ["columns", "rows"]}, "order"),
        ({"column_bits": 10}, "take 9"),
        ({"row_bits": True}, "row_bits"),
        ({"first_bit": "left"}, "first_bit"),
        ({"inverses": 1}, "inverses"),
        ({"offset": [1]}, "offset"),
        ({"colour": "blue"}, "colour"),
        (7, "description"),
    ],
)
def test_what_is_not_understood_is_refused(value, word):
    with pytest.raises(BadInput, match=word) as caught:
        code_from(value, SIZE, "set.json: projector.pattern")
    assert caught.value.message.startswith("set.json: projector.pattern")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.sampled_from(SECTIONS),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(KEYS) | st.text(), inner),
)


@given(JSON)
def test_whatever_a_file_says(value):
    try:
        code = code_from(value, SIZE, "x")
    except BadInput:
        return
    assert code.slides.count(WHITE) == code.slides.count(BLACK) == 1


CODES = {
    "opencv": GrayCode.of(SIZE),
    "rows first, lsb first": GrayCode.of(
        SIZE, order=("white", "black", "rows", "columns"), lsb_first=True
    ),
    "without inverses": GrayCode.of(SIZE, inverses=False),
    "coarse and centred": GrayCode.of(SIZE, column_bits=7, row_bits=7, offset=(96, 8)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n == "opencv" else [pytest.mark.long]) for n in CODES]
)
def test_edges_are_where_they_are(name):
    """On a tilted, printed board in a camera with a lens: each edge to a fraction of a pixel."""
    scene, code = Scene(POSES[1], wall=None), CODES[name]
    decoded = decode(scene.pictures(code), code)
    for edges, axis in ((decoded.columns, 0), (decoded.rows, 1)):
        assert len(edges) > 2000
        off = edges.values - scene.truth(edges.places)[:, axis]
        assert abs(float(np.median(off))) < 0.02
        assert float(np.median(np.abs(off))) < 0.14
        assert float(np.mean(np.abs(off) < 0.5)) > 0.95


def error_px(decoded: Decoded, scene: Scene, places: np.ndarray, reach: float = 18.0) -> np.ndarray:
    local = at_places(decoded, places, np.full(len(places), reach))
    assert local.found.all()
    return np.linalg.norm(local.pixels - scene.truth(places), axis=1)


def corners(scene: Scene) -> np.ndarray:
    turned = BOARD.points @ scene.pose[:3, :3].T + scene.pose[:3, 3]
    return scene.camera.project(turned)


def test_between_pixels():
    scene = Scene(POSES[2])
    decoded = decode(scene.pictures(GrayCode.of(SIZE)), GrayCode.of(SIZE))
    places = corners(scene)
    assert np.sqrt(np.square(error_px(decoded, scene, places)).mean()) < 0.05
    local = at_places(decoded, places, np.full(len(places), 18.0))
    step = np.array([0.5, 0.0])
    slope = scene.truth(places + step) - scene.truth(places - step)
    assert np.allclose(local.slopes[:, :, 0], slope, atol=0.02)


def test_noise_shadow_and_glare():
    """What is shaded or saturated is left out, and spoils nothing of the rest."""
    code = GrayCode.of(SIZE)
    noisy = Scene(POSES[0], noise=6.0, exposure=120.0)
    assert error_px(decode(noisy.pictures(code), code), noisy, corners(noisy)).max() < 0.3
    shaded = Scene(POSES[0], shade=(0, 0, 150, 240))
    decoded = decode(shaded.pictures(code), code)
    assert decoded.shadow > 0.2
    assert decoded.columns.values.min() > 145.0
    places = corners(shaded)
    lit = shaded.truth(places)[:, 0] > 165.0
    assert 5 < lit.sum() < len(lit)
    assert error_px(decoded, shaded, places[lit]).max() < 0.15
    deep = shaded.truth(places)[:, 0] < 120.0
    assert not at_places(decoded, places[deep], np.full(deep.sum(), 18.0)).found.any()
    glaring = Scene(POSES[0], exposure=600.0)
    burnt = decode(glaring.pictures(code), code)
    assert burnt.saturated > 0.3
    near_ink = at_places(burnt, corners(glaring), np.full(35, 18.0))
    off = np.linalg.norm(near_ink.pixels - glaring.truth(corners(glaring)), axis=1)
    assert off[near_ink.found].max(initial=0.0) < 0.3


def test_two_surfaces_are_not_mixed():
    """Across the sheet's edge to the wall behind, nothing is told rather than a mean."""
    scene, code = Scene(POSES[0], wall=1.3), GrayCode.of(SIZE)
    decoded = decode(scene.pictures(code), code)
    outline = np.array([[-0.06, y, 0.0] for y in np.linspace(-0.03, 0.19, 12)])
    places = scene.camera.project(outline @ scene.pose[:3, :3].T + scene.pose[:3, 3])
    local = at_places(decoded, places, np.full(len(places), 18.0))
    off = np.linalg.norm(local.pixels - scene.truth(places), axis=1)
    beyond = places - [0.01, 0.0]
    rays = np.column_stack([scene.camera.normalise(beyond), np.ones(len(beyond))]) * 1.3
    on_wall = np.linalg.norm(local.pixels - scene._shown(rays), axis=1)
    told = local.found
    assert np.minimum(off, on_wall)[told].max(initial=0.0) < 0.3


def test_wrong_sequences_are_named():
    code = GrayCode.of(SIZE)
    pictures = Scene(POSES[0]).pictures(code)
    with pytest.raises(SolveError, match="brighter than the white"):
        decode([*pictures[:-2], pictures[-1], pictures[-2]], code)
    with pytest.raises(SolveError, match="is lit by the projector"):
        decode([pictures[-1]] * len(pictures), code)
