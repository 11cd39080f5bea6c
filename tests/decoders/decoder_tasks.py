"""Misbehaving tasks for a decoder's process; see test_decoders.py."""

import ctypes
import os
import signal
import socket
import time
from pathlib import Path

import numpy as np

from sceneprint.decoders.child_process import TASKS, serve


def _errno_of(do):
    try:
        do()
    except OSError as error:
        return error.errno or -1
    return 0


def _escape(_data, request):
    """Try to get out; the errors of each way."""
    tried = {
        "socket": lambda: socket.socket(socket.AF_INET),
        "read": lambda: Path("/etc/passwd").read_bytes(),
        "write": lambda: Path(request["path"]).write_bytes(b"x"),
        "fork": os.fork,
        "exec": lambda: os.execv("/bin/true", ["true"]),
        "signal": lambda: os.kill(os.getppid(), signal.SIGTERM),
        "list": lambda: list(Path("/").iterdir()),
    }
    return {name: _errno_of(do) for name, do in tried.items()}, ()


def _crash(_data, _request):
    ctypes.string_at(0)
    return {}, ()


def _hang(_data, _request):
    while True:
        pass


def _sleep(_data, _request):
    time.sleep(3600)
    return {}, ()


def _hoard(_data, request):
    return {"sum": float(np.ones(request["numbers"]).sum())}, ()


def _leave(_data, request):
    """Free an array of one value."""
    return {"sum": int(np.full(request["numbers"], 77, np.uint8).sum())}, ()


def _look(_data, request):
    """Count the bytes of that value in new memory of the same size."""
    return {"seen": int((np.empty(request["numbers"], np.uint8) == 77).sum())}, ()


def _fail(_data, _request):
    raise ZeroDivisionError("a bug of ours")


if __name__ == "__main__":
    serve(TASKS | {
        "escape": _escape, "crash": _crash, "hang": _hang, "sleep": _sleep, "hoard": _hoard,
        "fail": _fail, "leave": _leave, "look": _look,
    })  # fmt: skip
