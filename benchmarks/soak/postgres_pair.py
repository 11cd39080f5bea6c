"""A PostgreSQL primary and its standby, which can replace the primary.

primary, standby  --kill_primary-->  standby  --promote-->  primary  --renew-->  primary, standby
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import cast

from benchmarks.postgres import Server

DATABASE = "fleet"


class Pair:
    """A primary and its standby.

    `synchronous`: whether a commit waits for the standby.
    """

    def __init__(self, folder: Path, *, synchronous: bool) -> None:
        self._folders = (folder / f"server-{n}" for n in count(1))
        self._synchronous = synchronous
        self.primary = Server(next(self._folders), durable=True)
        self._standby: Server | None = None
        self._dead: Server | None = None

    def start(self) -> None:
        """Start the primary with its database, and a standby that replicates it."""
        self.primary.start()
        self.primary.create(DATABASE)
        self._standby = self.primary.standby(next(self._folders), synchronous=self._synchronous)
        self.ports = (self.primary.port, self._standby.port)

    def url(self, ports: Sequence[int] | None = None) -> str:
        """Return a URL that connects to the primary, optionally through other `ports`."""
        hosts = "&".join(f"host=127.0.0.1:{port}" for port in ports or self.ports)
        return f"postgresql+psycopg://postgres@/{DATABASE}?{hosts}&target_session_attrs=read-write"

    def stall(self) -> None:
        """Stop sending data to the standby, as if the link had failed."""
        for (pid,) in self.primary.execute("SELECT pid FROM pg_stat_replication"):
            os.kill(cast(int, pid), signal.SIGSTOP)

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Suspend the primary within the context, as if its disk hung."""
        self.primary.signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self.primary.signal(signal.SIGCONT)

    def promote(self) -> None:
        """Promote the standby, and return when it accepts writes."""
        assert self._standby is not None
        self._standby.promote()
        self._dead, self.primary, self._standby = self.primary, self._standby, None

    def unreceived(self) -> set[str]:
        """Start the dead primary alone, and return the ids of frames that only it has stored."""
        assert self._dead is not None
        alone = Server(self._dead.folder, durable=True, options={"synchronous_standby_names": ""})
        alone.start()
        try:
            return _frames(alone) - _frames(self.primary)
        finally:
            alone.stop()

    def renew(self) -> None:
        """Start a new standby of the new primary, at the address of the dead server."""
        assert self._dead is not None
        shutil.rmtree(self._dead.folder)
        self._standby = self.primary.standby(
            next(self._folders), synchronous=self._synchronous, port=self._dead.port
        )
        self._dead = None

    def end(self) -> None:
        """Kill all servers."""
        for server in (self.primary, self._standby):
            if server is not None:
                server.kill()


def _frames(server: Server) -> set[str]:
    return {str(name) for (name,) in server.execute("SELECT id FROM frames", DATABASE)}
