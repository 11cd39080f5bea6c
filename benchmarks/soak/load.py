"""What the soak uploads, and the processes it does it with.

A `Shot` is a small frame as a robot sends it. A `Part` is one process group of the service, which
can be killed and begun again.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sceneprint.formats.dataset import write_depth_png
from sceneprint.types import Intrinsics
from sceneprint_client.api import CameraIntrinsics, FrameMeta
from sceneprint_lab.synth import synthesise_room

#: Every so many samples of a frame, so that signing costs little; there are as many such frames
#: in one as samples that are left out.
STRIDE = 4
#: Frames that are taken in one room.
VIEWS = 5
MAP, MODEL = "soak", "depth"


@dataclass(frozen=True)
class Shot:
    """A frame as a robot sends it.

    Parameters
    ----------
    number : of the shot
    png : its file
    meta : its camera
    """

    number: int
    png: bytes
    meta: FrameMeta


def shots(n: int) -> list[Shot]:
    """`n` small frames of synthetic rooms, no two of the same content; the same ones each time."""
    per_room = VIEWS * STRIDE**2
    found: list[Shot] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.png"
        rooms = range(-(-n // per_room))
        for room in tqdm(rooms, desc="synthetic rooms", disable=None, leave=False):
            for frame in synthesise_room(77, room, VIEWS).frames:
                k = frame.intrinsics
                for place in range(STRIDE**2):
                    y, x = divmod(place, STRIDE)
                    depth = np.ascontiguousarray(frame.depth[y::STRIDE, x::STRIDE])
                    lens = Intrinsics(
                        depth.shape[1], depth.shape[0], k.fx / STRIDE, k.fy / STRIDE,
                        (k.cx - x) / STRIDE, (k.cy - y) / STRIDE,
                    )  # fmt: skip
                    write_depth_png(path, depth, 1000.0)
                    names = ("width", "height", "fx", "fy", "cx", "cy")
                    camera = CameraIntrinsics(**{name: getattr(lens, name) for name in names})
                    shot = Shot(len(found), path.read_bytes(), FrameMeta(intrinsics=camera))
                    found.append(shot)
    return found[:n]


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


class Part:
    """A command of ours in a process group of its own.

    Parameters
    ----------
    name : of the part
    arguments : of the command
    log : file that its standard error is appended to
    environment : beside this process's
    settings : as for Settings
    """

    def __init__(
        self, name: str, arguments: list[str], log: Path,
        environment: Mapping[str, str] | None = None, **settings: object,
    ) -> None:  # fmt: skip
        self.name = name
        self._arguments, self._log = arguments, log
        self._environment = (
            os.environ
            | dict(environment or {})
            | {f"SCENEPRINT_{key.upper()}": str(value) for key, value in settings.items()}
        )
        self._process: subprocess.Popen[bytes] | None = None

    def begin(self) -> None:
        """Start it."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", *self._arguments],
                env=self._environment, stdout=subprocess.DEVNULL, stderr=log,
                start_new_session=True,
            )  # fmt: skip

    @property
    def pid(self) -> int:
        """Process that leads the group."""
        assert self._process is not None
        return self._process.pid

    def children(self) -> list[int]:
        """Processes that the command has started."""
        found = []
        for status in Path("/proc").glob("[0-9]*/stat"):
            try:
                state, parent = status.read_text().rpartition(")")[2].split()[:2]
                line = (status.parent / "cmdline").read_bytes()
            except (OSError, ValueError):
                continue  # gone
            if int(parent) == self.pid and state != "Z" and b"spawn_main" in line:
                found.append(int(status.parent.name))
        return found

    def kill(self) -> None:
        """End all of it at once, as a power cut would."""
        if self._process is not None:
            os.killpg(self.pid, signal.SIGKILL)
            self._process.wait()
            self._process = None

    def end(self) -> None:
        """Ask it to end, and see that it does."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(60)
            except subprocess.TimeoutExpired:
                self.kill()
            self._process = None


def service(
    data: Path, port: int, workers: int = 0, environment: Mapping[str, str] | None = None,
    **settings: object,
) -> Part:  # fmt: skip
    """`sceneprint serve` on a data folder; `environment`, `settings`: as for `Part`."""
    given = ["--port", str(port), "--data", str(data), "--workers", str(workers)]
    log = data.with_suffix(".service.log")
    return Part("service", ["sceneprint", "serve", *given], log, environment, **settings)


def workers(data: Path, n: int, environment: Mapping[str, str] | None = None) -> Part:
    """`sceneprint work` on a data folder; `environment`: as for `Part`."""
    given = ["--data", str(data), "--workers", str(n)]
    log = data.with_suffix(".workers.log")
    # soon enough to publish, and to give up what a killed group of workers held
    settings = {"lease_s": 2, "tail_frames": 50}
    return Part("workers", ["sceneprint", "work", *given], log, environment, **settings)
