"""Small JPEG previews of camera pictures, for people who watch."""

from __future__ import annotations

import cv2

from cellctl.drivers.base import Image

MAX_SIDE_PX = 640
JPEG_QUALITY = 70


def encode_preview(image: Image) -> bytes:
    """`image` as JPEG, its longer side at most `MAX_SIDE_PX`."""
    height, width = image.shape[:2]
    scale = MAX_SIDE_PX / max(height, width)
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype("uint8", copy=False)
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return encoded.tobytes()
