"""The parts of a fleet on one machine: a database and its standby, service processes, workers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import httpx

from benchmarks.fleet.doors import PAUSE_S
from benchmarks.fleet.pair import Pair
from benchmarks.soak.load import Part, free_port
from sceneprint.engine import Engine
from sceneprint.settings import Settings

#: Seconds for all service processes to begin, on a machine that is busy with much else.
PATIENCE_S = 180.0
#: Settings of every process: keys are asked for, what a killed worker held is soon another's, and
#: indexes are published.
SETTINGS = {"require_keys": True, "lease_s": 5, "tail_frames": 100, "requests_per_s": 0}


class Fleet:
    """All processes; each service is a host of its own, which the workers are shared out among.

    Parameters
    ----------
    folder : of data and logs
    services, workers : how many processes of each
    synchronous : whether the database waits for its standby
    objects : keep blobs in an object store, and not in a folder that all hosts share
    """

    def __init__(
        self, folder: Path, services: int, workers: int, *, synchronous: bool, objects: bool
    ) -> None:
        self._folder = folder
        (folder / "database").mkdir()
        self.pair = Pair(folder / "database", synchronous=synchronous)
        self._sizes = services, workers
        self._shared: dict[str, object] = {}
        self.services: list[Part] = []
        self.workers: list[Part] = []
        self.urls: list[str] = []

    def begin(self) -> str:
        """Start all; the key of who may do everything."""
        n_services, n_workers = self._sizes
        self.pair.begin()
        self._shared = {**SETTINGS, "database_url": self.pair.url}
        with Engine(Settings(**self._settings(0))) as engine:
            secret = engine.create_key("fleet").secret
        for host in range(n_services):
            port = free_port()
            self.urls.append(f"http://127.0.0.1:{port}")
            command = ["serve", "--workers", "0", "--port", str(port)]
            self.services.append(self._part(f"service-{host + 1}", command, host))
        for number in range(n_workers):
            command = ["work", "--workers", "1"]
            self.workers.append(self._part(f"worker-{number + 1}", command, number % n_services))
        for part in (*self.services, *self.workers):
            part.begin()
        for url in self.urls:
            await_service(url)
        return secret

    def fsck(self) -> tuple[int, int]:
        """Leftovers and other findings of `sceneprint fsck`.

        Raises
        ------
        RuntimeError : it could not look.
        """
        report = self._folder / "fsck.json"
        environment = os.environ | _environment(self._settings(0))
        command = [sys.executable, "-m", "sceneprint", "fsck", "--grace", "0", "--json"]
        done = subprocess.run(
            [*command, str(report)], env=environment, capture_output=True, text=True, check=False
        )
        if not report.exists():
            raise RuntimeError(f"sceneprint fsck ended with {done.returncode}: {done.stderr}")
        findings = json.loads(report.read_text())["findings"]
        left = sum(one["severity"] == "leftover" for one in findings)
        return left, len(findings) - left

    def logs(self) -> dict[str, str]:
        """What the processes had to say, by their names."""
        return {path.stem: path.read_text() for path in sorted(self._folder.glob("*.log"))}

    def stop(self) -> None:
        """Ask services and workers to end."""
        for part in (*self.workers, *self.services):
            part.end()

    def end(self) -> None:
        """Kill all that runs."""
        for part in (*self.workers, *self.services):
            part.kill()
        self.pair.end()

    def _part(self, name: str, command: list[str], host: int) -> Part:
        log = self._folder / f"{name}.log"
        return Part(name, ["sceneprint", *command], log, **self._settings(host))

    def _settings(self, host: int) -> dict[str, object]:
        own = {
            "data_dir": self._folder / "shared", "index_dir": self._folder / f"index-{host + 1}"
        }  # fmt: skip
        return self._shared | own


def _environment(settings: dict[str, object]) -> dict[str, str]:
    return {f"SCENEPRINT_{name.upper()}": str(value) for name, value in settings.items()}


def await_service(url: str) -> None:
    """Return once a service can work.

    Raises
    ------
    RuntimeError : it does not come to it.
    """
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        try:
            if httpx.get(f"{url}/readyz", trust_env=False, timeout=5).is_success:
                return
        except httpx.TransportError:
            pass
        time.sleep(PAUSE_S)
    raise RuntimeError(f"{url} is not ready within {PATIENCE_S:g} s")
