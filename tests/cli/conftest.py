from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import structlog

from cellctl.cli.app import main
from tests.bus.conftest import daemon, endpoint  # noqa: F401 - fixtures
from tests.bus.toy import Daemon


@dataclass(frozen=True)
class Said:
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The one JSON object on stdout."""
        assert self.out.count("\n") == 1, self.out
        return json.loads(self.out)


Cellctl = Callable[..., Said]


@pytest.fixture
def offline(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Cellctl:
    """`cellctl ARGUMENTS`, in this process."""
    monkeypatch.setenv("COLUMNS", "120")

    def call(*arguments: str) -> Said:
        capsys.readouterr()
        code = main(arguments)
        out, err = capsys.readouterr()
        return Said(code, out, err)

    return call


@pytest.fixture(autouse=True)
def silent_logs() -> Iterator[None]:
    """The toy daemon lives in the process whose stdout is looked at."""
    structlog.configure(logger_factory=structlog.ReturnLoggerFactory())
    yield
    structlog.reset_defaults()


@pytest.fixture
def cellctl(offline: Cellctl, daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> Cellctl:  # noqa: F811
    """As `offline`, with a toy daemon to talk to."""
    monkeypatch.setenv("CELLCTL_CONNECT", daemon.endpoint)
    return offline
