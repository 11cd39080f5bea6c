"""What several rooms of the test suite share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the real recordings; tests that need them skip where it is absent."""
    root = Path(os.environ.get("SCENEPRINT_DATA", ROOT.parent / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"no real recordings at {root} (set SCENEPRINT_DATA)")
    return root
