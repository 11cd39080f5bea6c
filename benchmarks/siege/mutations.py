"""Uploads that are broken in every way: none may crash a process, fail with 5xx, or cost memory.

seed, number  --mutated-->  Upload  --besiege-->  MutationFigures
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import struct
import tempfile
import threading
import time
import traceback
import zlib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from tqdm import tqdm

from benchmarks.siege.sound_files import ARCHIVES, BAGS, CLOUDS, FILES, IMAGES
from benchmarks.soak.load import Part, Shot

#: Bytes that parsers of binary formats stumble over.
_WORDS = (
    b"\x00" * 4, b"\xff" * 4, b"\x7f\xff\xff\xff", b"\x80\x00\x00\x00", b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x01", b"IDAT", b"IEND", b"IHDR", b"PK\x03\x04", b"\x93NUMPY",
)  # fmt: skip
#: Uploads between two looks at the decoders.
_WATCHED = 50
_TEXTS = (
    "null", "-1", "1e999", "NaN", "[]", "{}", '""', '"\\ud800"', "18446744073709551616", "true",
    "[" * 500, '{"a":' * 200, '"' + "x" * 5000 + '"',
)  # fmt: skip
#: How often each kind is broken.
_WEIGHTS = {
    "json": 6.0, **dict.fromkeys(IMAGES, 3.0), **dict.fromkeys(CLOUDS, 1.0),
    **dict.fromkeys(ARCHIVES, 1.0), **dict.fromkeys(BAGS, 0.5), "png": 6.0,
}  # fmt: skip


@dataclass(frozen=True)
class Upload:
    """What is sent.

    Parameters
    ----------
    kind : of the file, or json: its metadata is broken
    data : the file
    meta : JSON text, or something like it
    """

    kind: str
    data: bytes
    meta: str


@dataclass(frozen=True)
class MutationFigures:
    """What came of it.

    Parameters
    ----------
    sent : by kind of file
    statuses : answers by status
    failed : answers with 5xx other than 503, and requests without an answer
    crashed : processes of the service, its workers, or that read recordings, that ended
    peak_bytes : most memory that one of the service and its workers took
    decoder_bytes : most memory that a decoder took
    replaced : decoders that crashed, or were ended beyond their limits
    seconds : in all
    """

    sent: dict[str, int]
    statuses: dict[int, int]
    failed: list[str]
    crashed: int
    peak_bytes: int
    decoder_bytes: int
    replaced: int
    seconds: float


def mutated(shots: list[Shot], seed: int, number: int) -> Upload:
    """The upload of a number: a sound one, broken in one to four places; the same each time."""
    rng = random.Random(f"{seed} {number}")
    shot = rng.choice(shots)
    kind = rng.choices(list(_WEIGHTS), list(_WEIGHTS.values()))[0]
    meta = shot.meta.model_dump_json()
    if kind == "json":
        return Upload(kind, shot.png, _broken_text(meta, rng))
    data = FILES[kind](shot)
    if kind in CLOUDS:
        meta = json.dumps({"format": "kitti"} if kind == "kitti" else {})
    for _ in range(rng.randint(1, 4)):
        data = _broken(data, rng)
    if rng.random() < 0.5:
        data = _sealed(data)
    return Upload(kind, data, meta)


def _sealed(data: bytes) -> bytes:
    """A broken PNG with the right check sums, so that what comes after them is reached."""
    at = data.find(b"\x89PNG") + 8
    out = bytearray(data)
    while 8 <= at <= len(data) - 12:
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            break
        struct.pack_into(">I", out, end, zlib.crc32(data[at + 4 : end]))
        at = end + 4
    return bytes(out)


def _broken(data: bytes, rng: random.Random) -> bytes:
    """Bytes with one thing wrong."""
    if not data:
        return rng.choice(_WORDS)
    at = rng.randrange(len(data)) if rng.random() < 0.5 else rng.randrange(min(len(data), 64))
    how = rng.randrange(7)
    if how == 0:
        return data[:at]
    if how == 1:
        return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
    if how == 2:
        word = rng.choice(_WORDS)
        return data[:at] + word + data[at + len(word) :]
    if how == 3:
        return data[:at] + rng.randbytes(rng.randint(1, 64)) + data[at:]
    if how == 4:
        return data[:at] + data[at + rng.randint(1, 256) :]
    if how == 5:
        end = at + rng.randint(1, 512)
        return data[:end] + data[at:]
    return data + rng.randbytes(rng.randint(1, 64))


def _broken_text(text: str, rng: random.Random) -> str:
    """JSON with a value, or a character, that is not what is expected."""
    if rng.random() < 0.5:
        known: dict[str, Any] = json.loads(text)
        place = known if rng.random() < 0.5 else known["intrinsics"]
        name = rng.choice([*place, "pose", "tags", "captured_at", "strange"])
        marked = {**place, name: "@@"}
        whole = marked if place is known else {**known, "intrinsics": marked}
        return json.dumps(whole).replace('"@@"', rng.choice(_TEXTS))
    return _broken(text.encode(), rng).decode("utf-8", "replace")


def read_bag(kind: str, data: bytes) -> tuple[int, str, int]:
    """Read a recording as commands do, in this process.

    Returns
    -------
    status : 200 where it was read, 422 where it was refused, 500 for an error nobody raised on
        purpose
    text : of the error
    peak : most memory that this process ever had, bytes
    """
    from sceneprint.errors import SceneprintError
    from sceneprint.formats.dataset import find_sequences
    from sceneprint.formats.recording import RecordingOptions

    status, text = 200, ""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run.{kind.partition('.')[0]}"
        path.write_bytes(data)
        try:
            for topic in ("/points", "/depth/image_raw"):
                options = RecordingOptions(topic=topic, keyframe_m=0, keyframe_s=0)
                for sequence in find_sequences(path, options):
                    for frame in sequence.frames:
                        frame.read()
        except SceneprintError as error:
            status, text = 422, str(error)
        except Exception:
            status, text = 500, traceback.format_exc()
    return status, text, _peak(os.getpid())


def besiege(
    url: str, parts: list[Part], shots: list[Shot], n: int, seed: int, threads: int = 4
) -> MutationFigures:
    """Send mutated uploads to a service, and watch its processes.

    Parameters
    ----------
    url : of the service
    parts : that it runs as
    shots : to break
    n : how many are sent
    seed : of the breaking
    threads : that send
    """
    before = {pid for part in parts for pid in [part.pid, *part.children()]}
    decoders = _DecoderWatch(parts)
    statuses: Counter[int] = Counter()
    sent: Counter[str] = Counter()
    failed: list[str] = []
    crashed = peak = 0
    lock = threading.Lock()
    start = time.perf_counter()
    bar = tqdm(total=n, desc="mutated uploads", disable=None, leave=False)

    def send(number: int) -> None:
        nonlocal crashed, peak
        upload = mutated(shots, seed, number)
        try:
            status, text = _send(client, upload, number)
            if upload.kind in BAGS and status < 500:
                status, text, held = readers.submit(read_bag, upload.kind, upload.data).result()
                peak = max(peak, held)
        except (httpx.HTTPError, BrokenProcessPool) as error:
            status, text = 0, repr(error)
        if number % _WATCHED == 0:
            decoders.look()
        with lock:
            bar.update()
            sent[upload.kind] += 1
            statuses[status] += 1
            crashed += "BrokenProcessPool" in text
            if status == 0 or (status >= 500 and status != 503):
                failed.append(f"upload {number} of {upload.kind}: {status} {text[-2000:]}")

    client = httpx.Client(base_url=url, timeout=60, trust_env=False)  # all threads may use it
    readers = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
    with bar, client, readers, ThreadPoolExecutor(threads) as pool:
        list(pool.map(send, range(n)))
    seconds = time.perf_counter() - start
    decoders.look()
    after = {pid for part in parts for pid in [part.pid, *part.children()]}
    return MutationFigures(
        dict(sent), dict(sorted(statuses.items())), failed, len(before - after) + crashed,
        max(peak, *map(_peak, after)), decoders.peak_bytes, len(decoders.gone), seconds,
    )  # fmt: skip


class _DecoderWatch:
    """What the decoders of some processes are seen to take, and which of them ended.

    A decoder without kernels gives way to one with them, once for each place: these are not
    counted as replaced.
    """

    def __init__(self, parts: list[Part]) -> None:
        self._parts, self._known = parts, dict[int, bool]()
        self.gone: set[int] = set()
        self.peak_bytes = 0

    def look(self) -> None:
        """Look at those that there are now."""
        owners = {pid for part in self._parts for pid in [part.pid, *part.children()]}
        now = dict[int, bool]()
        for status in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError, ValueError):  # gone
                parent = int(status.read_text().rpartition(")")[2].split()[1])
                line = (status.parent / "cmdline").read_bytes()
                if parent in owners and b"sceneprint.decoders" in line:
                    pid = int(status.parent.name)
                    now[pid] = b"kernels" in line
                    self.peak_bytes = max(self.peak_bytes, _peak(pid))
        self.gone |= {pid for pid, compiled in self._known.items() if compiled and pid not in now}
        self._known |= now


def _send(client: httpx.Client, upload: Upload, number: int) -> tuple[int, str]:
    if upload.kind in ARCHIVES or (upload.kind in BAGS and number % 2):
        kind = "application/zip" if upload.kind == "zip" else "application/gzip"
        answer = client.post(
            "/v1/maps/siege/imports", content=upload.data, headers={"Content-Type": kind}
        )
        return answer.status_code, answer.text
    # now to be kept, now to be asked with: both read it
    path = "frames" if number % 2 else "queries"
    answer = client.post(
        f"/v1/maps/siege/{path}",
        files={"frame": ("frame", upload.data, "application/octet-stream")},
        data={"meta": upload.meta},
    )
    return answer.status_code, answer.text


def _peak(pid: int) -> int:
    """Most memory that a process ever had, bytes."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    return 0
