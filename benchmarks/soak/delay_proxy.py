"""Proxy that delays messages between two programs on one machine, like a network."""

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
    """A process that forwards connections to a port and delays each message.

    Parameters
    ----------
    port : local port to which connections are forwarded
    delay_s : delay of each message in either direction, seconds
    """

    def __init__(self, port: int, delay_s: float) -> None:
        context = get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(target=_serve, args=(sender, port, delay_s), daemon=True)
        self._process.start()
        self.port: int = receiver.recv()

    def freeze(self) -> None:
        """Stop forwarding without closing connections, like a network that loses all packets."""
        self._send(signal.SIGSTOP)

    def thaw(self) -> None:
        """Continue forwarding, including messages that arrived meanwhile."""
        self._send(signal.SIGCONT)

    def _send(self, number: signal.Signals) -> None:
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    def end(self) -> None:
        """End the process, which closes its connections."""
        self._process.kill()
        self._process.join()


def _serve(sender: Pipe, port: int, delay_s: float) -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=256) as listener:
        sender.send(listener.getsockname()[1])
        while True:
            near, _ = listener.accept()
            try:
                far = socket.create_connection(("127.0.0.1", port))
            except OSError:  # the port has no listener now
                near.close()
                continue
            for wire in (near, far):
                wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=_join, args=(near, far, delay_s), daemon=True).start()


def _join(near: socket.socket, far: socket.socket, delay_s: float) -> None:
    """Forward in both directions until both ends are closed."""
    with near, far:
        back = threading.Thread(target=_pump, args=(far, near, delay_s), daemon=True)
        back.start()
        _pump(near, far, delay_s)
        back.join()


def _pump(source: socket.socket, to: socket.socket, delay_s: float) -> None:
    """Forward each message after its delay."""
    coming, is_open = deque[tuple[float, bytes]](), True
    with suppress(OSError):
        while is_open or coming:
            wait_s = max(coming[0][0] - time.monotonic(), 0.0) if coming else None
            # `select` has a timeout with a resolution below a millisecond.
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
