"""Processes of a plan on one machine: services, workers, and servers of their data."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Self

from benchmarks.machine import peak_bytes, read_process, running_processes
from benchmarks.s3 import ObjectServer
from benchmarks.soak.delay_proxy import DelayProxy
from benchmarks.soak.plan import Plan
from benchmarks.soak.postgres_pair import Pair
from benchmarks.waiting import answers, free_port, until
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.settings import Settings
from sceneprint.store import Store, open_store

#: Settings of every process. With short leases, another worker soon continues a job after a kill.
SETTINGS = {
    "SCENEPRINT_REQUIRE_KEYS": "1", "SCENEPRINT_JOB_LEASE_S": "5",
    "SCENEPRINT_UNINDEXED_FRAMES": "100", "SCENEPRINT_TENANT_REQUESTS_PER_S": "0",
}  # fmt: skip
#: Delays of a message to the database, and to the object store, in a slow network, seconds.
DATABASE_S, STORE_S = 0.0005, 0.01
#: Minimum size of the disk to be filled, a file system in memory, and size per second of the run:
#: a longer run stores more frames. Bytes.
DISK_BYTES, DISK_BYTES_PER_S = 384 << 20, 1 << 20
#: Script that creates a key with all permissions.
_CREATE_KEY = """
import sys
from contextlib import closing
from sceneprint.engine.admin.operations import create_key
from sceneprint.settings import Settings
from sceneprint.store import open_store

settings = Settings(data_dir=sys.argv[1])
with closing(open_store(settings.database, settings.blobs)) as store:
    print(create_key(store, "operator").secret)
"""


class Part:
    """A command of sceneprint in its own process group.

    Parameters
    ----------
    arguments : arguments of `sceneprint`
    log : file to which its standard error is appended
    """

    def __init__(self, arguments: list[str], log: Path, environment: Mapping[str, str]) -> None:
        self._arguments, self._log, self._environment = arguments, log, environment
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the command."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "sceneprint", *self._arguments], env=self._environment,
                stdout=subprocess.DEVNULL, stderr=log, start_new_session=True,
            )  # fmt: skip

    @property
    def pid(self) -> int:
        """Id of the process that leads the group."""
        assert self._process is not None
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Return whether the command has started and not ended."""
        return self._process is not None and self._process.poll() is None

    def peak_bytes(self) -> int:
        """Return the maximum of the peak memories of the group's processes, bytes."""
        return max(peak_bytes(pid) for pid, group, _ in running_processes() if group == self.pid)

    def children(self) -> list[int]:
        """Return the ids of the workers that the command has started."""
        return [
            pid for pid, _, parent in running_processes()
            if parent == self.pid and b"spawn_main" in read_process(pid, "cmdline")
        ]  # fmt: skip

    def kill(self) -> None:
        """Kill the whole group at once, as in a power failure."""
        if self._process is not None:
            os.killpg(self.pid, signal.SIGKILL)
            self._process.wait()
            self._process = None

    def end(self) -> None:
        """Terminate the command, and kill it if it does not end."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(60)
                self._process = None
            except subprocess.TimeoutExpired:
                self.kill()


class Fleet:
    """All processes of a plan, from `start` to the end of the context.

    On PostgreSQL, each service has its own host, and the workers are distributed over the hosts. On
    SQLite, all share a data folder.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder, self._plan, self._opened = folder, plan, ExitStack()
        self.services: list[Part] = []
        self.workers: list[Part] = []
        self.urls: list[str] = []
        self.pair: Pair | None = None
        #: The disk of uploads, if it is a separate file system.
        self._disk: Path | None = None
        #: The delayed connections from each host to the servers.
        self._networks: list[list[DelayProxy]] = []
        self._objects = ObjectServer() if plan.objects else None
        self._shared = dict(SETTINGS)
        if plan.is_crowd:
            self._shared["SCENEPRINT_BUILD_SURFACES"] = "on_request"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def start(self) -> str:
        """Start all processes, and return a key with all permissions."""
        plan = self._plan
        if plan.count("full-disk"):
            disk = self.folder / ("host-1" if plan.store == "sqlite" else "blobs")
            disk.mkdir()
            size = f"size={max(DISK_BYTES, round(plan.seconds * DISK_BYTES_PER_S))}"
            subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(disk)], check=True)
            self._disk = disk
            self._opened.callback(subprocess.run, ["umount", str(disk)], check=True)
        if plan.store == "postgresql":
            (self.folder / "database").mkdir()
            self.pair = Pair(self.folder / "database", synchronous=not plan.asynchronous)
            self._opened.callback(self.pair.end)
            self.pair.start()
            blobs = f"file://{self.folder / 'blobs'}"
            if self._objects is not None:
                self._opened.enter_context(self._objects)
                blobs = f"{self._objects.bucket('fleet')}/blobs"
                self._shared |= self._objects.env
            self._shared |= {
                "SCENEPRINT_DATABASE_URL": self.pair.url(), "SCENEPRINT_BLOB_URL": blobs
            }  # fmt: skip
        secret = subprocess.run(
            [sys.executable, "-c", _CREATE_KEY, str(self.folder / "host-1")], check=True, text=True,
            env=os.environ | self._shared, stdout=subprocess.PIPE,
        ).stdout.strip()  # fmt: skip
        hosts = [self._host_environment() for _ in range(plan.services)]
        for number in range(plan.services):
            port = free_port()
            self.urls.append(f"http://127.0.0.1:{port}")
            command = ["serve", "--workers", "0", "--port", str(port)]
            self.services.append(self._part(f"service-{number + 1}", command, number, hosts))
        for number in range(plan.workers):
            command = ["work", "--workers", "1"]
            self.workers.append(self._part(f"worker-{number + 1}", command, number, hosts))
        for part in (*self.services, *self.workers):
            self._opened.callback(part.kill)
            part.start()
        for url in self.urls:
            await_service(url)
        return secret

    def _part(
        self, name: str, command: list[str], number: int, hosts: list[dict[str, str]]
    ) -> Part:
        host = number % len(hosts)
        data = self.folder / f"host-{1 if self.pair is None else host + 1}"
        log = self.folder / f"{name}.log"
        return Part([*command, "--data", str(data)], log, os.environ | hosts[host])

    def _host_environment(self) -> dict[str, str]:
        """Return the environment of a new host, with delayed or separable links if required."""
        self._networks.append([])
        if self.pair is None or not (self._plan.delays or self._plan.count("partition")):
            return self._shared
        database = [self._reachable_port(port, DATABASE_S) for port in self.pair.ports]
        own = self._shared | {"SCENEPRINT_DATABASE_URL": self.pair.url(database)}
        if self._objects is not None:
            port = self._reachable_port(self._objects.port, STORE_S)
            own["AWS_ENDPOINT_URL"] = f"http://127.0.0.1:{port}"
        return own

    def _reachable_port(self, port: int, delay_s: float) -> int:
        """Create a link from the new host to a server, and return its port."""
        proxy = DelayProxy(port, delay_s if self._plan.delays else 0.0)
        self._opened.callback(proxy.end)
        self._networks[-1].append(proxy)
        return proxy.port

    @contextmanager
    def partitioned(self, host: int) -> Iterator[None]:
        """Cut a host off from the database and the object store; clients still reach it."""
        for proxy in self._networks[host]:
            proxy.freeze()
        try:
            yield
        finally:
            for proxy in self._networks[host]:
                proxy.thaw()

    @contextmanager
    def full_disk(self) -> Iterator[None]:
        """Fill the disk of uploads within the context."""
        assert self._disk is not None
        ballast = self._disk / "ballast"
        with ballast.open("wb", buffering=0) as file:
            for block in (1 << 20, 1 << 12, 1):
                with suppress(OSError):
                    while True:
                        file.write(bytes(block))
        try:
            yield
        finally:
            ballast.unlink()

    def memory(self) -> tuple[int, int]:
        """Return the maximum peak memory of services and of workers, bytes."""
        peaks = [
            max(part.peak_bytes() for part in parts) for parts in (self.services, self.workers)
        ]
        return peaks[0], peaks[1]

    def log_lines(self) -> list[str]:
        """Return the lines of all logs."""
        logs = sorted(self.folder.glob("*.log"))
        return [line for log in logs for line in log.read_text(errors="replace").splitlines()]

    def fsck(self) -> tuple[int, int]:
        """Return the number of unreferenced files, and of damages that `sceneprint fsck` finds."""
        with self.settings() as settings:
            counts = Counter(finding.severity for finding in fsck(settings, grace_s=0.0))
        return counts["leftover"], counts["damage"]

    @contextmanager
    def store(self) -> Iterator[Store]:
        """Open the store in this process."""
        with (
            self.settings() as settings,
            closing(open_store(settings.database, settings.blobs)) as store,
        ):
            yield store

    def stop(self) -> None:
        """Terminate services and workers."""
        for part in (*self.workers, *self.services):
            part.end()

    @contextmanager
    def settings(self) -> Iterator[Settings]:
        """Give this process the environment of the first host within the context."""
        before = dict(os.environ)
        os.environ.update(self._shared)
        try:
            yield Settings(data_dir=self.folder / "host-1")
        finally:
            os.environ.clear()
            os.environ.update(before)


def await_service(url: str) -> None:
    """Wait until a service is ready."""
    until(partial(answers, f"{url}/readyz"), pause_s=0.1)
