"""What the projector shows: every marker once, found again where it was drawn."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cellctl.calib.patterns import detect_markers, marker_pictures
from cellctl.errors import BadInput

SIZE = (1920, 1080)


def test_every_marker_is_shown_once():
    pictures = marker_pictures(SIZE)
    shown = [number for picture in pictures for number in picture.centres]
    assert len(pictures) == 4
    assert sorted(shown) == list(range(240))
    assert all(picture.image.shape == (1080, 1920) for picture in pictures)


@pytest.mark.parametrize("pictures", [1, 4])
def test_drawn_centres_are_found_at_once(pictures):
    for picture in marker_pictures(SIZE, pictures=pictures):
        soft = cv2.GaussianBlur(picture.image, (0, 0), 1.0)
        found = detect_markers(soft)
        assert found.keys() == picture.centres.keys()
        off = np.array([found[i] - picture.centres[i] for i in found])
        assert np.abs(off).max() < 0.01


def test_centres_survive_perspective():
    """Where the diagonals cross is the picture of the centre; the mean of the corners is not."""
    picture = marker_pictures(SIZE)[0]
    H = np.array([[0.6, 0.05, 100.0], [-0.04, 0.55, 120.0], [1.5e-4, 1e-4, 1.0]])
    image = cv2.warpPerspective(
        cv2.GaussianBlur(picture.image, (0, 0), 1.5), H, (1280, 800), borderValue=255
    )
    found = detect_markers(image)
    assert len(found) > 50
    for number, pixel in found.items():
        expected = H @ np.append(picture.centres[number], 1.0)
        assert np.abs(pixel - expected[:2] / expected[2]).max() < 0.1


def test_more_pictures_make_larger_markers():
    sides = [marker_pictures(SIZE, pictures=n)[0].marker_px for n in (1, 4, 9)]
    assert sides == sorted(set(sides))
    assert marker_pictures(SIZE, pictures=1, minimum_px=100)[0].marker_px >= 100


def test_white_margins_are_a_module_wide():
    for picture in marker_pictures(SIZE):
        module = picture.marker_px // 6
        for centre in picture.centres.values():
            x, y = (centre - (picture.marker_px - 1) / 2).astype(int)
            side = picture.marker_px
            around = picture.image[y - module : y + side + module, x - module : x + side + module]
            assert around.shape == (side + 2 * module, side + 2 * module)
            assert (around[:module] == 255).all()
            assert (around[:, -module:] == 255).all()


@pytest.mark.parametrize(
    ("columns", "rows", "options", "words"),
    [
        (20, 13, {}, "at most 250"),
        (1, 12, {}, "at least 2"),
        (20, 12, {"minimum_px": 500}, "fewer markers"),
        (20, 12, {"pictures": 99}, "fewer markers"),
    ],
)
def test_what_cannot_be_shown_is_refused(columns, rows, options, words):
    with pytest.raises(BadInput, match=words):
        marker_pictures(SIZE, columns, rows, **options)
