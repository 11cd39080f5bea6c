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


def test_kills_and_power_cuts_at_some_calls():
    operations, faults = ("upload", "signature", "publication", "deletion"), ("kill", "power cut")
    chosen = [part for fault in faults for part in ("--fault", fault)]
    result = counts(*operations, "--store", "sqlite", *chosen, "--first", "3", "--step", "9")
    assert result.keys() == set(operations)
    assert min(tried[fault] for tried in result.values() for fault in faults) > 0


@pytest.mark.thorough
@pytest.mark.parametrize("store", ["sqlite", "postgresql"])
@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_call(operation, store):
    result = counts(operation, "--store", store)
    assert result.keys() == {operation}
    assert result[operation].keys() == FAULTS.keys()
    assert result[operation]["kill"] > 3
