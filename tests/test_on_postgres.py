"""Tests on PostgreSQL that detect most in a second; `make test-postgres` runs all."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
#: Files by what they need to begin; a process of pytest for each.
GROUPS = {
    "engine": (
        "on_postgres/test_switch.py", "engine/test_uploads.py", "engine/test_jobs.py",
        "engine/test_tombstones.py",
    ),
    "service": (
        "service/test_maps_and_frames.py", "service/test_events.py", "service/test_idempotency.py",
        "service/test_faults.py",
    ),
}  # fmt: skip


@pytest.mark.usefixtures("postgres")  # skips where there is no server
@pytest.mark.thorough
@pytest.mark.parametrize("group", ["engine", "service"])
def test_what_holds_on_sqlite_holds_on_postgresql(group, tmp_path):
    outside = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "0", "-q", "-p", "no:cacheprovider", "--tb=short",
         "--basetemp", str(tmp_path / "base"), *[str(TESTS / name) for name in GROUPS[group]]],
        env=outside | {
            "SCENEPRINT_TEST_DATABASE": "postgresql", "PYTHONPATH": str(TESTS / "on_postgres"),
        },
        cwd=TESTS.parent, capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    last = done.stdout.splitlines()[-1]
    assert "passed" in last
    assert "failed" not in last
