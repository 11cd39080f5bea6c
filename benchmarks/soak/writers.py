"""Robots of the soak: over HTTP from a thread, or embedded in a process that can be killed.

What is to be sent is taken from a `Plan`, and is sent again until it is acknowledged.
"""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

from benchmarks.soak.load import MAP, Shot
from sceneprint.errors import SceneprintError, UnknownFrame
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta

T = TypeVar("T")


class Plan:
    """Which shots are still to be sent, and what was acknowledged.

    Parameters
    ----------
    numbers : of the shots
    """

    def __init__(self, numbers: range) -> None:
        self._left = list(reversed(numbers))
        self._leave = threading.Semaphore(0)
        self.lock = threading.Lock()
        self.total = len(numbers)
        #: Ids of the frames by the numbers of their shots: what must never be lost.
        self.acknowledged: dict[int, str] = {}
        #: Ids of the frames whose deletion was acknowledged.
        self.deleted: set[str] = set()
        self.retries = 0

    def release(self, n: int) -> None:
        """Let `n` more shots be sent."""
        for _ in range(n):
            self._leave.release()

    def take(self) -> int | None:
        """The next shot that may be sent; None where all were taken."""
        self._leave.acquire()
        with self.lock:
            return self._left.pop() if self._left else None

    def acknowledge(self, number: int, frame_id: str) -> None:
        """Note that a shot is safe."""
        with self.lock:
            self.acknowledged[number] = frame_id

    @staticmethod
    def is_deleted(number: int) -> bool:
        """Whether a shot is to be deleted again: one in ten."""
        return number % 10 == 3


class RemoteWriter(threading.Thread):
    """A robot that talks to the service.

    Parameters
    ----------
    url : of the service
    shots : all
    plan : shared with the other writers
    """

    def __init__(self, url: str, shots: list[Shot], plan: Plan) -> None:
        super().__init__(daemon=True)
        self._url, self._shots, self._plan = url, shots, plan

    def run(self) -> None:
        """Send until there is nothing left."""
        with Client(self._url) as client:
            while (number := self._plan.take()) is not None:
                frame_id = self._insist(partial(_sent, client, self._shots[number]))
                self._plan.acknowledge(number, frame_id)
                if Plan.is_deleted(number):
                    self._insist(partial(_gone, client, frame_id))
                    self._plan.deleted.add(frame_id)

    def _insist(self, do: Callable[[], T]) -> T:
        while True:
            try:
                return do()
            except SceneprintError:  # no service for a while, or one that was cut off half way
                self._plan.retries += 1
                time.sleep(0.05)


def _sent(client: Client, shot: Shot) -> str:
    return client.upload(MAP, shot.png, shot.meta).frame_id


def _gone(client: Client, frame_id: str) -> None:
    with suppress(UnknownFrame):  # the deletion was done, and its answer lost
        client.delete_frame(MAP, frame_id)


class EmbeddedWriter(threading.Thread):
    """A robot without a service, in a process of its own that may be killed at any time.

    Parameters
    ----------
    data : folder
    shots_file : as `write_shots` made it
    plan : shared with the other writers
    """

    def __init__(self, data: Path, shots_file: Path, plan: Plan) -> None:
        super().__init__(daemon=True)
        self.name = "writer"
        self._data, self._shots_file, self._plan = data, shots_file, plan
        self._process: subprocess.Popen[str] | None = None

    def run(self) -> None:
        """Hand numbers to the process, one at a time, and begin another when it was killed."""
        while (number := self._plan.take()) is not None:
            frame_id = ""
            while not frame_id:
                frame_id = self._ask(number)
            self._plan.acknowledge(number, frame_id)
            if Plan.is_deleted(number):
                while self._ask(number, f"delete {frame_id}") != "deleted":
                    pass
                self._plan.deleted.add(frame_id)
        self.end()

    def kill(self) -> None:
        """Kill the process; the thread begins another."""
        process = self._process
        if process is not None:
            process.kill()

    def end(self) -> None:
        """Kill the process for good, and let go of what belongs to it."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()

    def _ask(self, number: int, line: str | None = None) -> str:
        """The answer of the process; nothing where it died before it gave one."""
        process = self._process
        if process is None:
            process = self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, str(self._data), str(self._shots_file)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
            )  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(f"{line or f'add {number}'}\n")
            answer = process.stdout.readline()
        except OSError:
            answer = ""
        if not answer.endswith("\n"):  # killed
            self._plan.retries += 1
            self.end()
            return ""
        return answer.strip()


def write_shots(shots: list[Shot], path: Path) -> None:
    """Keep shots for the processes of the embedded writers."""
    rows = [
        {"png": base64.b64encode(one.png).decode(), "meta": one.meta.model_dump(mode="json")}
        for one in shots
    ]
    path.write_text(json.dumps(rows))


def read_shots(path: Path) -> list[Shot]:
    """What `write_shots` wrote."""
    return [
        Shot(number, base64.b64decode(row["png"]), FrameMeta.model_validate(row["meta"]))
        for number, row in enumerate(json.loads(path.read_text()))
    ]


def main(data: str, shots_file: str) -> None:
    """Do what standard input says, a line each, and acknowledge on standard output."""
    shots = read_shots(Path(shots_file))
    with Client.embedded(data) as client:
        for line in sys.stdin:
            what, _, which = line.strip().partition(" ")
            if what == "delete":
                _gone(client, which)
                print("deleted", flush=True)
            else:
                print(_sent(client, shots[int(which)]), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
