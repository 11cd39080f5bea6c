"""A fault at some calls of each operation, or at every call in the thorough tests."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.injection import FAULTS
from tests.faults.operations import OPERATIONS

pytestmark = pytest.mark.sqlite_only("makes stores of its own, on either database")

ROOT = Path(__file__).resolve().parents[2]
#: Names the call that fails in each of eight attempts to write a file.
CALLS = """
import sys
from pathlib import Path
from sceneprint.atomic_files import write_durable
from tests.faults.injection import Injector

for at in range(1, 9):
    injector = Injector(Path(sys.argv[1]), "full disk", at)
    injector.arm()
    try:
        write_durable(Path(sys.argv[1]) / str(at), b"data")
    except OSError:
        pass
    injector.disarm()
    print(injector.failed or "none")
"""


def run(*arguments):
    """Run Python in a process of its own, since children are forked from it."""
    done = subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def counts(*options):
    """Return the numbers of calls tried, by operation and fault; no invariant may be broken."""
    report = run("-m", "tests.faults", "--json", *options)
    return json.loads(report)


def test_calls_fail_one_after_another(tmp_path):
    # the file and its writer are opened and the file is synced; then its name, and its folder
    calls = ["open", "open", "os.fsync", "os.rename", "os.fsync"]
    assert run("-c", CALLS, str(tmp_path)).split("\n")[:8] == [*calls, "none", "none", "none"]


def test_kills_at_some_calls():
    operations = ("upload", "signature", "deletion")
    found = counts(
        *operations, "--store", "sqlite", "--fault", "kill", "--first", "3", "--step", "9"
    )
    assert found.keys() == set(operations)
    assert min(tried["kill"] for tried in found.values()) > 0


@pytest.mark.thorough
@pytest.mark.parametrize("store", ["sqlite", "postgresql"])
@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_call(operation, store):
    found = counts(operation, "--store", store)
    assert found.keys() == {operation}
    assert found[operation].keys() == FAULTS.keys()
    assert found[operation]["kill"] > 3
