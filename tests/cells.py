"""A small cell's configuration for tests that need no simulated world."""

from __future__ import annotations

from typing import Any

from cellctl.config import CellConfig, parse_config


def document() -> dict[str, Any]:
    """A UR5 before a table, everything where the tape says it is."""
    down = [180.0, 0.0, 0.0]
    return {
        "config_version": 1,
        "cell": {"id": "test", "motion_enabled": True},
        "simulation": {"preset": "cr"},
        "robot": {"driver": "sim", "arm": "ur5"},
        "camera": {
            "driver": "sim",
            "image_size_px": [1920, 1080],
            "factory": {"focal_px": [915.0, 914.0], "centre_px": [958.0, 548.0]},
            "pose": {"position_m": [0.0, -0.44, 0.8], "rpy_deg": down},
        },
        "projector": {
            "driver": "sim",
            "size_px": [1920, 1080],
            "throw_ratio": 1.55,
            "centre_px": [960.0, 1134.0],
            "latency_s": 0.07,
            "pose": {"position_m": [0.0, -0.7, 1.3], "rpy_deg": down},
        },
        "table": {
            "pose": {"position_m": [0.0, -0.44, 0.0], "rpy_deg": [0.0, 0.0, 0.0]},
            "touched_height_m": 0.0,
            "area_m": [0.67, 0.375],
        },
        "bracket": {
            "checkerboard": {
                "board": {"type": "chessboard", "inner_corners": [9, 6], "square_m": 0.03},
                "pose": {"position_m": [0.27, -0.12, 0.08], "rpy_deg": [0.0, 0.0, 90.0]},
                "hull": {"min_m": [0.07, -0.18, 0.06], "max_m": [0.33, 0.18, 0.11]},
            },
            "markers": {
                "board": {
                    "type": "aruco-grid",
                    "markers": [3, 4],
                    "marker_m": 0.05,
                    "pitch_m": 0.06,
                    "dictionary": "DICT_4X4_50",
                },
                "pose": {"position_m": [-0.27, -0.115, 0.08], "rpy_deg": [0.0, 0.0, 0.0]},
                "hull": {"min_m": [-0.3, -0.15, 0.06], "max_m": [-0.07, 0.15, 0.11]},
            },
            "pen": {"tip_m": [0.0, 0.0, 0.18], "radius_m": 0.02},
        },
        "workspace": {"box": {"min_m": [-0.9, -1.0, -0.05], "max_m": [0.9, 0.7, 1.2]}},
    }


def config() -> CellConfig:
    return parse_config(document(), "tests/cells.py")
