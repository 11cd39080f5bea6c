"""Fixtures of the worker tests: two worker processes, and frames that arrive slowly."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.waiting import PATIENCE_S, until
from sceneprint.settings import Settings
from sceneprint_client.api import Added, FrameMeta, NewMap
from tests.whole_engine import Engine

LEASE_S = 1.5  # a busy machine sometimes renews a lease late


@dataclass
class Crew:
    """Two worker processes and a store; this process acts as the service."""

    engine: Engine
    errors: Path
    process: subprocess.Popen[bytes]

    def log(self, message):
        text = self.errors.read_text()
        lines = [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]
        return [line for line in lines if line["message"] == message]

    def rows(self, statement):
        with self.engine.store.database.read() as connection:
            return [tuple(row) for row in connection.exec_driver_sql(statement)]

    def change(self, statement):
        with self.engine.store.database.write() as connection:
            connection.exec_driver_sql(statement)

    def settled(self, map_name, count):
        """Wait until all frames of a map are indexed."""
        until(lambda: self.engine.get_map(map_name).frames == {"indexed": count})

    def job(self, job_id, columns):
        (row,) = self.rows(f"SELECT {columns} FROM jobs WHERE id = '{job_id}'")
        return row

    def pid(self, job_id):
        """Return the process id of the worker that holds or last held a job."""
        (worker,) = self.job(job_id, "worker")
        return int(worker.rpartition(":")[2]) if worker else 0

    def signed(self, map_name):
        """Return the number of signatures of each frame of a map."""
        statement = (
            "SELECT count(*) FROM signatures s JOIN frames f ON f.number = s.frame_number "
            f"JOIN maps m ON m.number = f.map_number AND m.name = '{map_name}' GROUP BY f.number"
        )
        return [count for (count,) in self.rows(statement)]

    def pause(self):
        """Stop both workers while neither is writing, since its lock would block others."""
        with self.engine.store.database.write():
            self.send(signal.SIGSTOP)

    def send(self, number, workers=2):
        """Send a signal to both workers or to the first one."""
        for line in self.log("worker ready")[:workers]:
            os.kill(int(line["worker"].rpartition(":")[2]), number)


@pytest.fixture(scope="module")
def frames(room_frames, small_image):
    """Small frames with different content, from different offsets."""
    results = []
    for number in range(64):
        data, lens = small_image(room_frames[number // 16], *divmod(number % 16, 4))
        results.append((data, FrameMeta(intrinsics=lens)))
    return results


@pytest.fixture(scope="session")
def hire(tmp_path_factory):
    """A function that runs a command with two workers on a separate store with the map `warm`."""

    @contextmanager
    def run(command, **settings):
        folder = tmp_path_factory.mktemp("crew")
        errors = tmp_path_factory.mktemp("errors") / "stderr"
        options = {"data_dir": folder, "workers": 2, **settings}
        names = {f"SCENEPRINT_{name.upper()}": str(value) for name, value in options.items()}
        with Engine(Settings.model_validate(options)) as engine:
            engine.create_map(NewMap(name="warm", model="depth"))
            with errors.open("wb") as out:
                process = subprocess.Popen(
                    command, stderr=out, start_new_session=True, env=os.environ | names
                )
            crew = Crew(engine, errors, process)
            try:
                until(lambda: len(crew.log("worker ready")) == 2)
                yield crew
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    return run


@pytest.fixture(scope="module")
def crew(hire):
    with hire([f"{Path(sys.executable).parent}/sceneprint", "work"], job_lease_s=LEASE_S) as crew:
        yield crew
        crew.process.terminate()
        assert crew.process.wait(PATIENCE_S) == 0
        assert len(crew.log("worker stopped")) == 2
        assert crew.log("worker died") == []


@dataclass
class Slow:
    """A frame whose bytes come from a pipe, like those of a slow disk."""

    added: Added
    pipe: Path
    data: bytes

    def give(self):
        """Write all bytes for the reader of the pipe."""
        opened = until(self._opened)
        assert os.write(opened, self.data) == len(self.data)
        os.close(opened)

    def _opened(self):
        try:
            return os.open(self.pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            return 0  # the pipe has no reader yet


@pytest.fixture
def slow(crew, frames):
    """A function that uploads a frame whose blob is a pipe, before any worker claims it."""

    def make(name, number):
        crew.engine.create_map(NewMap(name=name, model="depth"))
        crew.pause()
        added, _ = crew.engine.add_frame(name, *frames[number])
        ((blob,),) = crew.rows(f"SELECT blob FROM frames WHERE id = '{added.frame_id}'")
        path = crew.engine.settings.blob_dir / blob[:2] / blob
        path.unlink()
        pipe = path.with_suffix(".pipe")
        os.mkfifo(pipe)
        path.hardlink_to(pipe)
        crew.send(signal.SIGCONT)
        until(lambda: crew.pid(added.job_id))
        return Slow(added, pipe, frames[number][0])

    return make
