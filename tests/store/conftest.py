"""Fixtures of the store tests: an open store, jobs to claim, and racing processes."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, event, update

from benchmarks.waiting import PATIENCE_S
from sceneprint.store import Store, open_database, open_store, queue
from sceneprint.store.maps import add_frame, add_map, store_model
from sceneprint.store.tables import FrameRow, JobRow, MapRow, jobs
from sceneprint_client.api import JobState

MODEL = "ab" * 32

#: Script that starts processes at once, and returns results as JSON, or errors as name and text.
NURSERY = """
import json, sys
from multiprocessing import get_context
import sceneprint.engine.admin.operations

fork = get_context("fork")

def run(i, work, start, told):
    start.wait()
    try:
        told.put([i, work(i)])
    except BaseException as error:
        told.put([i, f"{type(error).__name__}: {error}"])

for line in sys.stdin:
    code, count, args = json.loads(line)
    names = {"ARGS": args}
    exec(code, names)
    start, told = fork.Barrier(count), fork.Queue()
    children = [
        fork.Process(target=run, args=(i, names["work"], start, told)) for i in range(count)
    ]
    for child in children:
        child.start()
    results = dict(told.get(timeout=240) for _ in children)
    for child in children:
        child.join()
    print(json.dumps([results[i] for i in range(count)]), flush=True)
"""


@pytest.fixture(scope="session")
def race() -> Iterator[Callable[..., list[Any]]]:
    """A function that runs `work(i)` of a script in several processes at once with ARGS."""
    nursery = subprocess.Popen(
        [sys.executable, "-c", NURSERY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert nursery.stdin is not None
    assert nursery.stdout is not None
    to, of = nursery.stdin, nursery.stdout

    def run(code: str, count: int, *args: object) -> list[Any]:
        print(json.dumps([code, count, [str(one) for one in args]]), file=to, flush=True)
        answer = of.readline()
        assert answer, "the processes did not end well: see their traceback above"
        found: list[Any] = json.loads(answer)
        return found

    yield run
    nursery.communicate(timeout=PATIENCE_S)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a database test on both databases, or only on SQLite if it concerns SQLite."""
    if "url" in metafunc.fixturenames:
        marked = metafunc.definition.get_closest_marker("sqlite_only") is not None
        alone = marked or "plans" in metafunc.fixturenames
        metafunc.parametrize("url", ["sqlite"] if alone else ["sqlite", "postgresql"],
                             indirect=True)  # fmt: skip


@pytest.fixture(scope="session")
def empty_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty SQLite file with the current schema, since copying is faster than creating."""
    path = tmp_path_factory.mktemp("empty") / "truth.db"
    open_database(f"sqlite:///{path}").close()
    assert [one.name for one in path.parent.iterdir()] == [path.name]  # the log is empty
    return path


@pytest.fixture
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of a new database; on a server it already has the schema."""
    if request.param == "postgresql":
        (
            tmp_path / "blobs"
        ).mkdir()  # the store does not create the folder for an existing database
        return str(request.getfixturevalue("postgres_url"))
    return f"sqlite:///{tmp_path / 'truth.db'}"


@pytest.fixture
def store(url: str, empty_file: Path, tmp_path: Path) -> Iterator[Store]:
    if url.startswith("sqlite"):
        (tmp_path / "blobs").mkdir()
        shutil.copyfile(empty_file, tmp_path / "truth.db")
    opened = open_store(url, tmp_path / "blobs")
    yield opened
    opened.database.close()


@pytest.fixture
def hall(store: Store) -> MapRow:
    """An empty map."""
    with store.database.write() as connection:
        store_model(connection, MODEL, "toy", b"the file of a model")
        return add_map(connection, "hall", None, MODEL)


@pytest.fixture
def received(store: Store, hall: MapRow) -> Callable[..., FrameRow]:
    """A function that inserts a frame with default fields."""

    def add(
        content: str, row: MapRow = hall, frame_id: str | None = None,
        within: Connection | None = None, **given: object,
    ) -> FrameRow:  # fmt: skip
        values: dict[str, Any] = {
            "content_id": content, "blob": "00" * 32, "bytes": 3, "intrinsics": {"width": 1},
            "depth_scale": 1000.0, "depth_along_ray": False, "robot": None, "session": None,
            "captured_at": None, "tags": [], "pose_parent": None, "pose": None, "name": None,
            "sequence": None,
        }  # fmt: skip
        if within is not None:
            return add_frame(within, row.number, values | given, frame_id)
        with store.database.write() as connection:
            return add_frame(connection, row.number, values | given, frame_id)

    return add


@pytest.fixture
def queued(store: Store, received: Callable[..., FrameRow]) -> Callable[..., JobRow]:
    """A function that queues a job for a new frame."""

    def add(name: str, priority: int = 0) -> JobRow:
        frame = received(name)
        with store.database.write() as connection:
            return queue.enqueue(connection, "sign", frame.number, priority)

    return add


@pytest.fixture
def turned(store: Store) -> Callable[..., None]:
    """A function that sets columns of a job, such as an expired lease."""

    def write(job: JobRow, **values: object) -> None:
        with store.database.write() as connection:
            connection.execute(update(jobs).where(jobs.c.number == job.number).values(**values))

    return write


class Hand:
    """A worker's access to the queue."""

    def __init__(self, store: Store) -> None:
        self.database = store.database

    def take(self, worker: str = "w", lease_s: float = 60.0) -> JobRow | None:
        with self.database.write() as connection:
            return queue.claim(connection, worker, lease_s)

    def taken(self, worker: str = "w", lease_s: float = 60.0) -> JobRow:
        held = self.take(worker, lease_s)
        assert held is not None
        return held

    def row(self, job: JobRow) -> JobRow:
        with self.database.read() as connection:
            return queue.find_job(connection, job.id)

    def fail(self, held: JobRow, error: str = "broke", trace: str = "Trace") -> JobState:
        with self.database.write() as connection:
            return queue.fail(connection, held, error, trace)

    def due(self) -> bool:
        with self.database.read() as connection:
            return queue.has_due(connection)


@pytest.fixture
def hand(store: Store) -> Hand:
    return Hand(store)


@pytest.fixture(scope="session")
def plans() -> Callable[[Connection], AbstractContextManager[list[str]]]:
    """A context that returns SQLite's query plans of all statements of a connection."""

    @contextmanager
    def looked_at(connection: Connection) -> Iterator[list[str]]:
        told: list[str] = []

        def explain(_: Any, cursor: Any, statement: str, parameters: Any, *__: Any) -> None:
            cursor.execute(f"EXPLAIN QUERY PLAN {statement}", parameters)
            told.extend(row[3] for row in cursor.fetchall())

        event.listen(connection, "before_cursor_execute", explain)
        yield told
        event.remove(connection, "before_cursor_execute", explain)

    return looked_at


@pytest.fixture(scope="session")
def opens() -> str:
    """Code for `race` that opens the database of a URL and returns its schema version."""
    return """
from sceneprint.store import open_database
from sqlalchemy import text

def work(i):
    database = open_database(ARGS[0])
    with database.read() as connection:
        found = connection.execute(text("SELECT version_num FROM alembic_version")).all()
    database.close()
    return [row[0] for row in found]
"""
