from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from cellctl.bus.client import Client
from cellctl.bus.session import free_endpoint
from tests.bus.toy import Daemon


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def daemon(endpoint: str, tmp_path: Path) -> Iterator[Daemon]:
    with Daemon(endpoint, tmp_path) as running:
        yield running


@pytest.fixture
def client(daemon: Daemon) -> Iterator[Client]:
    with Client(daemon.endpoint) as connected:
        yield connected
