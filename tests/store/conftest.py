"""Fixtures of the store tests: an open store, jobs to claim, and racing processes."""

import json
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest
from sqlalchemy import event, update

from benchmarks.waiting import PATIENCE_S
from sceneprint.store import open_database, open_store, queue
from sceneprint.store.maps import add_frame, add_map, store_model
from sceneprint.store.tables import jobs
from tests.store.frame_rows import frame_values

MODEL = "ab" * 32

#: Script that starts processes at once, and returns results as JSON, or errors as name and text.
NURSERY = """
import json, sys
from multiprocessing import get_context
import sceneprint.engine.admin.operations

fork = get_context("fork")

def run(i, work, start, queue):
    start.wait()
    try:
        queue.put([i, work(i)])
    except BaseException as error:
        queue.put([i, f"{type(error).__name__}: {error}"])

for line in sys.stdin:
    code, count, args = json.loads(line)
    names = {"ARGS": args}
    exec(code, names)
    start, queue = fork.Barrier(count), fork.Queue()
    children = [
        fork.Process(target=run, args=(i, names["work"], start, queue)) for i in range(count)
    ]
    for child in children:
        child.start()
    results = dict(queue.get(timeout=240) for _ in children)
    for child in children:
        child.join()
    print(json.dumps([results[i] for i in range(count)]), flush=True)
"""


@pytest.fixture(scope="session")
def race():
    """A function that runs `work(i)` of a script in several processes at once with ARGS."""
    nursery = subprocess.Popen(
        [sys.executable, "-c", NURSERY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert nursery.stdin is not None
    assert nursery.stdout is not None
    to, of = nursery.stdin, nursery.stdout

    def run(code, count, *args):
        print(json.dumps([code, count, [str(argument) for argument in args]]), file=to, flush=True)
        answer = of.readline()
        assert answer, "the processes did not end well: see their traceback above"
        return json.loads(answer)

    yield run
    nursery.communicate(timeout=PATIENCE_S)


def pytest_generate_tests(metafunc):
    """Run a database test on both databases, or only on SQLite if it concerns SQLite."""
    if "url" in metafunc.fixturenames:
        marked = metafunc.definition.get_closest_marker("sqlite_only") is not None
        alone = marked or "plans" in metafunc.fixturenames
        metafunc.parametrize("url", ["sqlite"] if alone else ["sqlite", "postgresql"],
                             indirect=True)  # fmt: skip


@pytest.fixture(scope="session")
def empty_file(tmp_path_factory):
    """An empty SQLite file with the current schema, since copying is faster than creating."""
    path = tmp_path_factory.mktemp("empty") / "truth.db"
    open_database(f"sqlite:///{path}").close()
    assert [path.name for path in path.parent.iterdir()] == [path.name]  # the log is empty
    return path


@pytest.fixture
def url(request, tmp_path):
    """URL of a new database; on a server it already has the schema."""
    if request.param == "postgresql":
        (tmp_path / "blobs").mkdir()  # the store creates none for an existing database
        return str(request.getfixturevalue("postgres_url"))
    return f"sqlite:///{tmp_path / 'truth.db'}"


@pytest.fixture
def store(url, empty_file, tmp_path):
    if url.startswith("sqlite"):
        (tmp_path / "blobs").mkdir()
        shutil.copyfile(empty_file, tmp_path / "truth.db")
    opened = open_store(url, tmp_path / "blobs")
    yield opened
    opened.database.close()


@pytest.fixture
def hall(store):
    """An empty map."""
    with store.database.write() as connection:
        store_model(connection, MODEL, "toy", b"the file of a model")
        return add_map(connection, "hall", None, MODEL)


@pytest.fixture
def received(store, hall):
    """A function that inserts a frame with default fields."""

    def add(content, row=hall, frame_id=None, within=None, **fields):
        values = frame_values(content, **fields)
        if within is not None:
            return add_frame(within, row.number, values, frame_id)
        with store.database.write() as connection:
            return add_frame(connection, row.number, values, frame_id)

    return add


@pytest.fixture
def queued(store, received):
    """A function that queues a job for a new frame."""

    def add(name, priority=0):
        frame = received(name)
        with store.database.write() as connection:
            return queue.enqueue(connection, "sign", frame.number, priority)

    return add


@pytest.fixture
def turned(store):
    """A function that sets columns of a job, such as an expired lease."""

    def write(job, **values):
        with store.database.write() as connection:
            connection.execute(update(jobs).where(jobs.c.number == job.number).values(**values))

    return write


class Hand:
    """A worker's access to the queue."""

    def __init__(self, store):
        self.database = store.database

    def do(self, call, *arguments):
        """Call a function of the queue in a transaction of its own."""
        with self.database.write() as connection:
            return call(connection, *arguments)

    def take(self, worker="w", lease_s=60.0):
        with self.database.write(turn=False) as connection:  # as workers do
            return queue.claim(connection, worker, lease_s)

    def taken(self, worker="w", lease_s=60.0):
        held = self.take(worker, lease_s)
        assert held is not None
        return held

    def row(self, job):
        with self.database.read() as connection:
            return queue.find_job(connection, job.id)

    def fail(self, held, error="broke", trace="Trace"):
        return self.do(queue.fail, held, error, trace)

    def due(self):
        with self.database.read() as connection:
            return queue.has_due(connection)


@pytest.fixture
def hand(store):
    return Hand(store)


@pytest.fixture(scope="session")
def plans():
    """A context that returns SQLite's query plans of all statements of a connection."""

    @contextmanager
    def looked_at(connection):
        steps = []

        def explain(_, cursor, statement, parameters, *__):
            cursor.execute(f"EXPLAIN QUERY PLAN {statement}", parameters)
            steps.extend(row[3] for row in cursor.fetchall())

        event.listen(connection, "before_cursor_execute", explain)
        yield steps
        event.remove(connection, "before_cursor_execute", explain)

    return looked_at


#: Code for `race` that opens the database of a URL and returns its schema version.
SCHEMA_OF = """
from sceneprint.store import open_database
from sqlalchemy import text

def work(i):
    database = open_database(ARGS[0])
    with database.read() as connection:
        found = connection.execute(text("SELECT version_num FROM alembic_version")).all()
    database.close()
    return [row[0] for row in found]
"""
