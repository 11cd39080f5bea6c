"""A fault at some calls of each operation, or at every call in the thorough tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.postgres import Server
from sceneprint.atomic_files import write_durable
from sceneprint.engine.ingest.uploads import Upload
from tests.faults.enumeration import Child, Enumeration
from tests.faults.injection import FAULTS, Injector
from tests.faults.operations import OPERATIONS, small_uploads

pytestmark = pytest.mark.sqlite_only("makes stores of its own, on either database")


@pytest.fixture(scope="module")
def uploads() -> tuple[Upload, ...]:
    return small_uploads()


@pytest.fixture(scope="module")
def on_sqlite(uploads: tuple[Upload, ...], tmp_path_factory: pytest.TempPathFactory) -> Enumeration:
    return Enumeration(tmp_path_factory.mktemp("faults") / "stores", uploads)


def test_calls_fail_one_after_another(tmp_path: Path) -> None:
    failed = []
    for at in range(1, 9):

        def write(say: object, at: int = at) -> None:
            injector = Injector(tmp_path, "full disk", at)
            injector.arm()
            try:
                write_durable(tmp_path / f"{at}", b"data")
            except OSError:
                failed_call = injector.failed
            else:
                failed_call = "none"
            say(failed_call)  # type: ignore[operator]

        failed += Child(write).lines
    # the file and its writer are opened and the file is synced; then its name, and its folder
    calls = ["open", "open", "os.fsync", "os.rename", "os.fsync"]
    assert failed == [*calls, "none", "none", "none"]


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_kill_now_and_then(on_sqlite: Enumeration, operation: str) -> None:
    trials = on_sqlite.run(operation, "kill", first=3, step=11)
    assert trials.calls > 0
    assert trials.violations == []


@pytest.mark.thorough
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_call_on_sqlite(on_sqlite: Enumeration, operation: str, fault: str) -> None:
    trials = on_sqlite.run(operation, fault)
    assert trials.calls > 0
    assert trials.violations == []


@pytest.fixture(scope="module")
def on_postgresql(
    uploads: tuple[Upload, ...], postgres: Server, tmp_path_factory: pytest.TempPathFactory
) -> Enumeration:
    return Enumeration(tmp_path_factory.mktemp("faults") / "stores", uploads, postgres)


@pytest.mark.thorough
@pytest.mark.parametrize("fault", ["input/output error", "kill"])
@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_call_on_postgresql(on_postgresql: Enumeration, operation: str, fault: str) -> None:
    trials = on_postgresql.run(operation, fault)
    assert trials.calls > 0
    assert trials.violations == []
