"""Two PostgreSQL servers, of which one follows the other and takes its place.

primary, standby  --kill_primary-->  standby  --promote-->  primary  --renew-->  primary, standby
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from benchmarks.postgres import Server

DATABASE = "fleet"


class Pair:
    """A primary and its standby, and who of them is which.

    Parameters
    ----------
    folder : of their data
    synchronous : whether a commit waits for the standby
    """

    def __init__(self, folder: Path, *, synchronous: bool) -> None:
        self._folder, self._synchronous = folder, synchronous
        self._made = 0
        self.primary = Server(self._next(), durable=True)
        self._standby: Server | None = None
        self._dead: Server | None = None

    def start(self) -> None:
        """Start the primary with its database, and a standby that follows it."""
        self.primary.start()
        self.primary.create(DATABASE)
        self._standby = self.primary.standby(self._next(), synchronous=self._synchronous)
        self._ports = (self.primary.port, self._standby.port)

    @property
    def ports(self) -> tuple[int, ...]:
        """Of both hosts."""
        return self._ports

    @property
    def url(self) -> str:
        """Of both hosts: whoever takes writes is the primary."""
        return self.url_at(self._ports)

    def url_at(self, ports: Sequence[int]) -> str:
        """As `url`, where the hosts are reached by other ports."""
        hosts = "&".join(f"host=127.0.0.1:{port}" for port in ports)
        return f"postgresql+psycopg://postgres@/{DATABASE}?{hosts}&target_session_attrs=read-write"

    def stall(self) -> None:
        """Let nothing more come to the standby, as a link that has failed would."""
        senders = self.primary.execute("SELECT pid FROM pg_stat_replication")
        for (pid,) in senders:
            os.kill(cast(int, pid), signal.SIGSTOP)

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Let the primary do nothing meanwhile, as a machine whose disk hangs."""
        self.primary.signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self.primary.signal(signal.SIGCONT)

    def kill_primary(self) -> None:
        """End it at once, as a machine that dies."""
        self.primary.kill()

    def promote(self) -> None:
        """Make the standby the primary; returns when it takes writes."""
        standby = self._standby
        assert standby is not None
        standby.promote()
        self._dead, self.primary, self._standby = self.primary, standby, None

    def unreceived(self) -> set[str]:
        """Ids of frames that the dead primary has and the promoted one has not.

        The dead one is begun for itself, where nobody looks for it, and asked.
        """
        dead = self._dead
        assert dead is not None
        alone = Server(dead.folder, durable=True, options={"synchronous_standby_names": ""})
        alone.start()
        try:
            return _frames(alone) - _frames(self.primary)
        finally:
            alone.stop()

    def renew(self) -> None:
        """Let a new standby follow the new primary, on the address of the dead one."""
        dead = self._dead
        assert dead is not None
        shutil.rmtree(dead.folder)
        self._standby = self.primary.standby(
            self._next(), synchronous=self._synchronous, port=dead.port
        )
        self._dead = None

    def end(self) -> None:
        """Kill all that runs."""
        for server in (self.primary, self._standby):
            if server is not None:
                server.kill()

    def _next(self) -> Path:
        self._made += 1
        return self._folder / f"server-{self._made}"


def _frames(server: Server) -> set[str]:
    return {str(name) for (name,) in server.execute("SELECT id FROM frames", DATABASE)}
