"""The parts of a fleet on one machine: a database and its standby, service processes, workers."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path

import httpx

from benchmarks.fleet.delay_proxy import DelayProxy
from benchmarks.fleet.failover_client import PAUSE_S
from benchmarks.fleet.postgres_pair import Pair
from benchmarks.fleet.s3 import ObjectServer
from benchmarks.soak.load import Part, free_port
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.settings import Settings

#: Seconds for all service processes to begin, on a machine that is busy with much else.
PATIENCE_S = 180.0
#: Settings of every process: keys are asked for, what a killed worker held is soon another's, and
#: indexes are published.
SETTINGS = {
    "SCENEPRINT_REQUIRE_KEYS": "1", "SCENEPRINT_LEASE_S": "5", "SCENEPRINT_TAIL_FRAMES": "100",
    "SCENEPRINT_REQUESTS_PER_S": "0",
}  # fmt: skip


#: Seconds that a message to the database takes, and one to the object store, where asked for.
DATABASE_S, STORE_S = 0.0005, 0.01


class Fleet:
    """All processes; each service is a host of its own, which the workers are shared out among.

    Parameters
    ----------
    folder : of data and logs
    services, workers : how many processes of each
    synchronous : whether the database waits for its standby
    objects : keep blobs in an object store, and not in a folder that all hosts share
    delays : let messages to the database take DATABASE_S, and those to the object store STORE_S
    partitions : whether `partitioned` is asked for
    surfaces : whether maps get surfaces
    """

    def __init__(
        self, folder: Path, services: int, workers: int, *, synchronous: bool, objects: bool,
        delays: bool = False, partitions: bool = False, surfaces: bool = True,
    ) -> None:  # fmt: skip
        self.folder = folder
        self._delays, self._partitions, self._surfaces = delays, partitions, surfaces
        #: By which each host reaches the servers, where it does not reach them itself.
        self._networks: list[list[DelayProxy]] = []
        (folder / "database").mkdir()
        self.pair = Pair(folder / "database", synchronous=synchronous)
        self._sizes = services, workers
        self._objects = ObjectServer() if objects else None
        self._shared: dict[str, str] = {}
        self.services: list[Process] = []
        self.workers: list[Process] = []
        self.urls: list[str] = []

    def begin(self) -> str:
        """Start all; the key of who may do everything."""
        n_services, n_workers = self._sizes
        self.pair.begin()
        blobs = f"file://{self.folder / 'blobs'}"
        if self._objects is not None:
            self._objects.start()
            blobs = f"{self._objects.bucket('fleet')}/blobs"
            self._shared = dict(self._objects.env)
        self._shared |= SETTINGS | {
            "SCENEPRINT_DATABASE_URL": self.pair.url, "SCENEPRINT_BLOB_URL": blobs
        }  # fmt: skip
        if not self._surfaces:
            self._shared |= {"SCENEPRINT_SURFACES": "asked"}
        made = subprocess.run(
            [sys.executable, "-c", _MAKE_KEY, str(self.host)], check=True, text=True,
            env=self.environment(), stdout=subprocess.PIPE,
        )  # fmt: skip
        secret = made.stdout.strip()
        hosts = [self._host_environment() for _ in range(n_services)]
        for host in range(n_services):
            port = free_port()
            self.urls.append(f"http://127.0.0.1:{port}")
            command = ["serve", "--workers", "0", "--port", str(port)]
            self.services.append(self._part(f"service-{host + 1}", command, host, hosts[host]))
        for number in range(n_workers):
            command, host = ["work", "--workers", "1"], number % n_services
            self.workers.append(self._part(f"worker-{number + 1}", command, host, hosts[host]))
        for part in (*self.services, *self.workers):
            part.begin()
        for url in self.urls:
            await_service(url)
        return secret

    def _host_environment(self) -> dict[str, str]:
        """Of a host's processes, with a network of its own where messages take time or are lost."""
        self._networks.append([])
        if not (self._delays or self._partitions):
            return self._shared
        database = [self._reached(port, DATABASE_S) for port in self.pair.ports]
        own = self._shared | {"SCENEPRINT_DATABASE_URL": self.pair.url_at(database)}
        if self._objects is not None:
            port = self._reached(self._objects.port, STORE_S)
            own["AWS_ENDPOINT_URL"] = f"http://127.0.0.1:{port}"
        return own

    def _reached(self, port: int, delay_s: float) -> int:
        """By which port the last host reaches a server."""
        proxy = DelayProxy(port, delay_s if self._delays else 0.0)
        self._networks[-1].append(proxy)
        return proxy.port

    @contextmanager
    def partitioned(self, host: int) -> Iterator[None]:
        """Let nothing that a host's processes send come to the database or to the object store,
        nor what these answer; whoever asks the host reaches it.
        """
        for proxy in self._networks[host]:
            proxy.freeze()
        try:
            yield
        finally:
            for proxy in self._networks[host]:
                proxy.thaw()

    def memory(self) -> tuple[int, int]:
        """Most bytes that a process of the services, and one of the workers, ever had."""
        return _most_memory(self.services), _most_memory(self.workers)

    @property
    def host(self) -> Path:
        """Data folder of the first host."""
        return self.folder / "host-1"

    def environment(self) -> dict[str, str]:
        """Of a process of this version."""
        return os.environ | self._shared

    def fsck(self) -> tuple[int, int]:
        """Files that nothing refers to, and what is damaged; see `sceneprint fsck`."""
        with self._here() as settings:
            found = Counter(one.severity for one in fsck(settings, grace_s=0.0))
        return found["leftover"], found["damage"]

    def stop(self) -> None:
        """Ask services and workers to end."""
        for part in (*self.workers, *self.services):
            part.end()

    def end(self) -> None:
        """Kill all that runs."""
        for part in (*self.workers, *self.services):
            part.kill()
        self.pair.end()
        for proxy in chain.from_iterable(self._networks):
            proxy.end()
        if self._objects is not None:
            self._objects.kill()

    def _part(
        self, name: str, command: list[str], host: int, environment: Mapping[str, str]
    ) -> Process:
        arguments = ["sceneprint", *command, "--data", str(self.folder / f"host-{host + 1}")]
        log = self.folder / f"{name}.log"
        return Process(name, arguments, log, environment)

    @contextmanager
    def _here(self) -> Iterator[Settings]:
        """Let this process be one of the first host for a while."""
        before = dict(os.environ)
        os.environ.update(self._shared)
        try:
            yield Settings(data_dir=self.host)
        finally:
            os.environ.clear()
            os.environ.update(before)


def _most_memory(parts: Sequence[Process]) -> int:
    """The largest peak of resident memory of any process of some parts, bytes."""
    groups, most = {part.pid for part in parts}, 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            group = int(stat.read_text().rpartition(")")[2].split()[2])
            status = (stat.parent / "status").read_text()
        except OSError:
            continue  # gone
        peak = re.search(r"^VmHWM:\s+(\d+) kB", status, re.MULTILINE)
        if group in groups and peak is not None:
            most = max(most, 1024 * int(peak[1]))
    return most


#: Creates a key that may do everything.
_MAKE_KEY = """
import sys
from sceneprint.engine import Engine
from sceneprint.settings import Settings

with Engine(Settings(data_dir=sys.argv[1])) as engine:
    print(engine.create_key("fleet").secret)
"""


class Process(Part):
    """A part whose environment has more than settings.

    Parameters
    ----------
    name, arguments, log : see Part
    environment : beside this process's
    """

    def __init__(
        self, name: str, arguments: list[str], log: Path, environment: Mapping[str, str]
    ) -> None:
        super().__init__(name, arguments, log)
        self._environment = {**self._environment, **environment}


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
