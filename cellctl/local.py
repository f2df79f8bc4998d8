"""This machine: who asks here, and where its daemon listens."""

from __future__ import annotations

import getpass
import os

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7450"


def user() -> str:
    """The name of whoever runs this program; `uid1000` when it has none, as in containers."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid{os.getuid()}"
