"""A network between two programs of one machine: what goes through comes later."""

from __future__ import annotations

import os
import select
import signal
import socket
import threading
import time
from collections import deque
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection as Pipe


class DelayProxy:
    """A process of its own that hands on what comes to its port.

    Parameters
    ----------
    port : of this machine, that it hands on to
    delay_s : that each message takes, in either direction
    """

    def __init__(self, port: int, delay_s: float) -> None:
        context = get_context("spawn")
        told, tell = context.Pipe(duplex=False)
        self._process = context.Process(target=_hand_on, args=(tell, port, delay_s), daemon=True)
        self._process.start()
        self.port: int = told.recv()

    def freeze(self) -> None:
        """Let nothing through, and break nothing: as a network that loses everything."""
        os.kill(self._pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it through again, with all that has come meanwhile."""
        os.kill(self._pid, signal.SIGCONT)

    @property
    def _pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def end(self) -> None:
        """End it; connections break."""
        self._process.kill()
        self._process.join()


def _hand_on(tell: Pipe, port: int, delay_s: float) -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=256) as listener:
        tell.send(listener.getsockname()[1])
        while True:
            near, _ = listener.accept()
            try:
                far = socket.create_connection(("127.0.0.1", port))
            except OSError:  # nobody is there now
                near.close()
                continue
            for one in (near, far):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=_join, args=(near, far, delay_s), daemon=True).start()


def _join(near: socket.socket, far: socket.socket, delay_s: float) -> None:
    """Hand on in both directions, until both have ended."""
    with near, far:
        back = threading.Thread(target=_pump, args=(far, near, delay_s), daemon=True)
        back.start()
        _pump(near, far, delay_s)
        back.join()


def _pump(source: socket.socket, to: socket.socket, delay_s: float) -> None:
    """Hand on what comes, each message for itself: one that follows closely comes as closely."""
    coming, is_open = deque[tuple[float, bytes]](), True
    with suppress(OSError):
        while is_open or coming:
            wait_s = max(coming[0][0] - time.monotonic(), 0.0) if coming else None
            # of `select` alone the time is not counted in whole milliseconds
            if is_open and select.select([source], [], [], wait_s)[0]:
                data = source.recv(1 << 16)
                is_open = bool(data)
                coming.append((time.monotonic() + delay_s, data))
            elif not is_open and wait_s:
                time.sleep(wait_s)
            while coming and coming[0][0] <= time.monotonic():
                to.sendall(coming.popleft()[1])
    with suppress(OSError):
        to.shutdown(socket.SHUT_WR)
