"""A network between two programs of one machine: what goes through comes later."""

from __future__ import annotations

import socket
import threading
import time
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
    with suppress(OSError):
        while data := source.recv(1 << 16):
            time.sleep(delay_s)
            to.sendall(data)
    with suppress(OSError):
        to.shutdown(socket.SHUT_WR)
