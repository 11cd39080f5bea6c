"""Program of a decoder process: load all code, confine the process, and decode until it is killed.

    python -m sceneprint.decoders.child_process CONTROL PARENT BYTES plain|kernels [MORE]

CONTROL is a socket. A task is a line of JSON, followed by the bytes of the upload. A reply is the
length of its JSON, the JSON, and the arrays. BYTES limits the memory for work. MORE stands for
arguments of other programs. Nothing is pickled, and the parent checks every reply.
"""

from __future__ import annotations

import json
import mmap
import os
import signal
import struct
import sys
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.decoders.sandbox import close_process, die_with_parent
from sceneprint.errors import SceneprintError
from sceneprint.formats.depth_file import decode_samples, encode_npy, encode_png
from sceneprint.formats.points import pcd, ply, rows
from sceneprint.formats.points.cloud import read_points
from sceneprint.formats.points.rows import FileBytes
from sceneprint.geometry.kernel import Kernel
from sceneprint_client.formats import formats_of, function_at
from sceneprint_client.sidecars import UNSAID

#: Maximum size of a message, bytes, and maximum length of an error or traceback, characters.
MESSAGE_BYTES, MOST_TEXT = 1 << 16, 8000

#: Arrays that follow a reply.
Arrays = tuple[NDArray[Any], ...]
#: Function that takes the bytes of an upload and a request, and returns the reply and its arrays.
Task = Callable[[bytes, dict[str, Any]], tuple[dict[str, Any], Arrays]]


def _read_samples(data: bytes, _request: dict[str, Any]) -> tuple[dict[str, Any], Arrays]:
    samples = decode_samples(data)
    return {"type": samples.dtype.str, "shape": samples.shape}, (samples,)


def _read_points(data: bytes, request: dict[str, Any]) -> tuple[dict[str, Any], Arrays]:
    position = request["viewpoint"]
    viewpoint = (
        UNSAID if position == UNSAID.value else None if position is None else tuple(position)
    )
    cloud = read_points(data, request["format"], viewpoint, request["units_per_metre"])
    reply = {
        "shape": cloud.points.shape, "viewpoint": cloud.viewpoint,
        "file_points": cloud.file_points,
    }  # fmt: skip
    return reply, (cloud.points,)


TASKS: Mapping[str, Task] = {"samples": _read_samples, "points": _read_points}


def mapped(descriptor: int) -> FileBytes:
    """Map an open file into memory: a confined process can neither open files nor seek in them."""
    if os.fstat(descriptor).st_size == 0:
        return b""
    return mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)


def serve(tasks: Mapping[str, Task], warm: Callable[[bool], None] | None = None) -> None:
    """Run tasks until the parent closes the socket or exits.

    Parameters
    ----------
    tasks : functions by name
    warm : function that loads the code of the tasks, and the kernels if its argument is true; None
        selects `load_decoders`
    """
    control, parent, more_bytes = map(int, sys.argv[1:4])
    # signals that stop the service reach its process group, but uploads must finish
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    if not die_with_parent(parent):
        return
    incoming = os.fdopen(control, "rb")
    try:
        (warm or load_decoders)(sys.argv[4] == "kernels")
        _redirect_to_null()
        seccomp = close_process(more_bytes)
    except Exception:
        _send(control, {"broke": traceback.format_exc()[-MOST_TEXT:]})
        return
    _send(control, {"seccomp": seccomp})
    while message := incoming.readline(MESSAGE_BYTES):
        request = json.loads(message)
        _send(control, *_run_task(tasks, request, incoming.read(request["bytes"])))


def _run_task(
    tasks: Mapping[str, Task], request: dict[str, Any], data: bytes
) -> tuple[dict[str, Any], Arrays]:
    """Run a task on an upload; return its reply and arrays, or an error.

    An error reply has `error` and `text` if the upload is at fault, `memory` if memory ran out, or
    else `broke` with the traceback.
    """
    try:
        reply, arrays = tasks[request["task"]](data, request)
        return reply, tuple(map(np.ascontiguousarray, arrays))
    except SceneprintError as error:
        return {"error": type(error).__name__, "text": str(error)[:MOST_TEXT]}, ()
    except MemoryError:
        return {"memory": True}, ()
    except Exception:
        return {"broke": traceback.format_exc()[-MOST_TEXT:]}, ()


def _send(control: int, reply: dict[str, Any], arrays: Arrays = ()) -> None:
    text = json.dumps(reply).encode()
    whole = memoryview(struct.pack("<I", len(text)) + text)
    for data in (whole, *(array.reshape(-1).view(np.uint8).data for array in arrays)):
        left = data
        while left:
            left = left[os.write(control, left) :]


def _redirect_to_null() -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(nowhere, number)
    os.close(nowhere)


# A confined process can neither import nor compile, so all code runs once before confinement.


def load_decoders(kernels: bool) -> None:
    """Load the readers of all formats; the compiled readers (PCD and PLY) only if `kernels`."""
    for data in _image_samples():
        decode_samples(data)
    for data, form in array_samples():
        read_points(data, form, UNSAID, 1.0)
    for form in formats_of("depth", "cloud"):
        function_at(form.reader)
    with suppress(ImportError):  # lazrs is an optional dependency
        import lazrs  # noqa: F401
    for wrong in (b"\x89PNG\r\n\x1a\n" + bytes(40), b"\x93NUMPY\x01\x00\x02\x00{}", b"no image"):
        with suppress(SceneprintError):
            decode_samples(wrong)
    if not kernels:
        return
    for data, form in text_samples():
        read_points(data, form, UNSAID, 1.0)
    end_compilation(rows, pcd, ply)


def end_compilation(*modules: ModuleType) -> None:
    """Restrict the kernels of modules to the code that they have compiled."""
    for value in (value for module in modules for value in vars(module).values()):
        # kernels without signatures are inlined
        if isinstance(value, Kernel) and value.compiler.signatures:
            value.compiler.disable_compile()


def _image_samples() -> list[bytes]:
    images = [encode_png(np.ones((2, 2), np.uint16))]
    images.append(bytes(12) + images[0])  # compressedDepth
    return images + [encode_npy(np.ones((2, 2), kind)) for kind in ("f2", "f4", "f8", "u2")]


def array_samples() -> list[tuple[bytes, Any]]:
    """Return (content, format) of small files whose readers need no kernels."""
    points = np.ones((12, 3), np.float32)
    header = bytearray(227)
    struct.pack_into("<4s", header, 0, b"LASF")
    header[24:26] = 1, 2
    struct.pack_into("<HI", header, 94, 227, 227)
    struct.pack_into("<BHI", header, 104, 0, 20, 12)
    struct.pack_into("<6d", header, 131, 1, 1, 1, 0, 0, 0)
    las = bytes(header) + bytes(240)
    return [(encode_npy(points), "npy"), (bytes(16 * 12), "kitti"), (las, "las")]


def text_samples() -> list[tuple[bytes, Any]]:
    """Return (content, format) of small PCD and PLY files in all encodings.

    Reading them compiles the readers.
    """
    row = b"1 2 3\n"
    head = b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 12\nHEIGHT 1\n"
    head += b"POINTS 12\nDATA "
    plain = bytes(12 * 12)
    packed = b"".join(bytes([31]) + plain[i : i + 32] for i in range(0, 128, 32))
    packed += bytes([15]) + plain[128:]
    sizes = struct.pack("<II", len(packed), len(plain))
    vertex = b"element vertex 12\nproperty float x\nproperty float y\nproperty float z\n"
    listed = b"property list uchar int n\n"
    other = b"element other 1\nproperty list uchar int n\n"
    samples: list[tuple[bytes, Any]] = [
        (head + b"ascii\n" + 12 * row, "pcd"),
        (head + b"binary\n" + plain, "pcd"),
        (head + b"binary_compressed\n" + sizes + packed, "pcd"),
    ]
    for form in (b"ascii", b"binary_little_endian", b"binary_big_endian"):
        header = b"ply\nformat " + form + b" 1.0\n"
        text = form == b"ascii"
        body, lists, before = 12 * row, 12 * b"1 2 3 1 7\n", b"2 5 6\n"
        if not text:
            order = "<" if b"little" in form else ">"
            body = struct.pack(f"{order}3f", 1, 2, 3) * 12
            lists = struct.pack(f"{order}3fBi", 1, 2, 3, 1, 7) * 12
            before = struct.pack(f"{order}B2i", 2, 5, 6)
        end = b"end_header\n"
        samples.append((header + vertex + end + body, "ply"))
        samples.append((header + vertex + listed + end + lists, "ply"))
        samples.append((header + other + vertex + end + before + body, "ply"))
    return samples


if __name__ == "__main__":
    serve(TASKS)
