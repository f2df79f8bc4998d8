"""Functions for children to evaluate: plain, slow, wrong and deadly ones."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from cellctl.errors import BadInput, SolveError

LOCK_HOLDER_S = 60


def add(a: float, b: float) -> float:
    return a + b


def pid() -> int:
    return os.getpid()


def echo(value: Any) -> Any:
    return value


def scale(image: np.ndarray, factor: int) -> np.ndarray:
    image *= factor  # in place: what arrives must be writable
    return image


def fit(points: np.ndarray) -> list[float]:
    """A least-squares line: BLAS and LAPACK take part in the last digit."""
    a = np.column_stack([points[:, 0], np.ones(len(points))])
    return np.linalg.lstsq(a, points[:, 1], rcond=None)[0].tolist()


def threads() -> dict[str, Any]:
    import cv2

    return {"opencv": cv2.getNumThreads(), "blas": os.environ["OPENBLAS_NUM_THREADS"]}


def sleep(seconds: float) -> str:
    time.sleep(seconds)
    return "slept"


def hold_the_lock() -> None:
    """As a C extension that does not let go of the interpreter."""
    ctypes.PyDLL(None).sleep(LOCK_HOLDER_S)


def touch_and_sleep(path: str, seconds: float) -> None:
    Path(path).write_text(str(os.getpid()))
    time.sleep(seconds)


def raise_solve_error() -> NoReturn:
    raise SolveError("three views are too few", views=3, needed=4)


def raise_unpicklable() -> NoReturn:
    raise BadInput("odd", culprit=lambda: None)


def divide_by_zero() -> float:
    return 1 / 0


def exit_with(code: int) -> NoReturn:
    sys.exit(code)


def die_by(number: int) -> None:
    os.kill(os.getpid(), number)
    signal.pause()


def segfault() -> None:
    ctypes.string_at(0)


def chatter(lines: int) -> str:
    for number in range(lines):
        print(f"line {number}")
    sys.stderr.write("to stderr\n")
    os.write(1, b"to descriptor 1\n")
    return "quiet"


def read_stdin() -> str:
    return sys.stdin.read() if sys.stdin else os.read(0, 10).decode()


def unpicklable() -> Any:
    return lambda: None
