"""What the tests of PostgreSQL alone share: stores on it, and waiting for what comes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sceneprint.store import Store, open_store

#: Seconds that anything may take on the slowest machine.
PATIENCE_S = 90.0


@pytest.fixture(scope="session")
def until() -> Callable[[Callable[[], Any]], Any]:
    """Wait for the first true value of something."""

    def wait(what: Callable[[], Any]) -> Any:
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            if found := what():
                return found
            time.sleep(0.02)
        raise AssertionError("it did not come true")

    return wait


@pytest.fixture
def server_store(postgres_url: str, tmp_path: Path) -> Iterator[Store]:
    """A store on PostgreSQL."""
    opened = open_store(postgres_url, tmp_path / "blobs")
    yield opened
    opened.database.close()
