"""Uploads of damaged files, which must not crash a process, cause 5xx, or use much memory."""

from __future__ import annotations

import io
import json
import random
import struct
import tarfile
import threading
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
from tqdm import tqdm

from benchmarks.machine import running_processes
from benchmarks.soak.failover_client import bearer
from benchmarks.soak.processes import Part
from benchmarks.soak.recordings import Shot
from sceneprint.formats.depth_file import encode_npy
from sceneprint.formats.export import write_ply

#: Bytes that break parsers of binary formats.
_WORDS = (
    b"\x00" * 4, b"\xff" * 4, b"\x7f\xff\xff\xff", b"\x80\x00\x00\x00", b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x01", b"IDAT", b"IEND", b"IHDR", b"PK\x03\x04", b"\x93NUMPY",
)  # fmt: skip
_TEXTS = (
    "null", "-1", "1e999", "NaN", "[]", "{}", '""', '"\\ud800"', "18446744073709551616", "true",
    "[" * 500, '{"a":' * 200, '"' + "x" * 5000 + '"',
)  # fmt: skip
#: Points of a cloud, few enough that many changes hit the headers.
_POINTS = np.random.default_rng(0).uniform(-3, 3, (200, 3)).astype(np.float32)


def _npy(shot: Shot) -> bytes:
    k = shot.meta.intrinsics
    assert k is not None  # all frames are depth images
    return encode_npy(np.linspace(1, 3, k.width * k.height, dtype=np.float32).reshape(k.height, -1))


def _members(shot: Shot) -> dict[str, bytes]:
    k = shot.meta.intrinsics
    camera = {name: getattr(k, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {
        "room/seq-01/intrinsics.json": json.dumps(camera).encode(),
        "room/seq-01/frame-000000.depth.png": shot.png,
        "room/seq-02/000000.ply": write_ply(_POINTS),
    }


def _zip(shot: Shot) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in _members(shot).items():
            archive.writestr(zipfile.ZipInfo(name), data)  # a fixed time stamp
    return out.getvalue()


def _tar(shot: Shot) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for name, data in _members(shot).items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return out.getvalue()


#: Valid files by kind; the tests of formats damage files of other kinds.
CLOUDS: dict[str, Callable[[Shot], bytes]] = {
    "ply": lambda _: write_ply(_POINTS),
    "kitti": lambda _: np.column_stack([_POINTS, np.ones(200, np.float32)]).tobytes(),
    "npy cloud": lambda _: encode_npy(_POINTS),
}
ARCHIVES: dict[str, Callable[[Shot], bytes]] = {"zip": _zip, "tar": _tar}
FILES: dict[str, Callable[[Shot], bytes]] = {
    "png": lambda shot: shot.png,
    "npy": _npy,
    "compressedDepth": lambda shot: struct.pack("<iff", 0, 0.0, 0.0) + shot.png,
    **CLOUDS,
    **ARCHIVES,
}
#: Relative frequencies of the kinds.
_WEIGHTS = {**dict.fromkeys(FILES, 2.0), "json": 5.0, "png": 5.0}


@dataclass(frozen=True)
class BrokenUpload:
    """A damaged file and its metadata or, for the kind "json", a file and damaged metadata."""

    kind: str
    data: bytes
    meta: str


@dataclass(frozen=True)
class BrokenFigures:
    """Answers to broken uploads.

    Parameters
    ----------
    sent : number of uploads by kind of file
    statuses : number of answers by status
    failed : answers with 5xx other than 503, and requests without an answer
    crashed : number of services and workers that ended
    peak_bytes : peak memory of a process, including decoders
    seconds : total duration
    """

    sent: dict[str, int]
    statuses: dict[int, int]
    failed: list[str]
    crashed: int
    peak_bytes: int
    seconds: float


def damaged_upload(shots: list[Shot], seed: int, number: int) -> BrokenUpload:
    """Return an upload with one to four changes, which depend only on `seed` and `number`."""
    rng = random.Random(f"{seed} {number}")
    shot = rng.choice(shots)
    kind = rng.choices(list(_WEIGHTS), list(_WEIGHTS.values()))[0]
    meta = shot.meta.model_dump_json()
    if kind == "json":
        return BrokenUpload(kind, shot.png, _damage_json(meta, rng))
    data = FILES[kind](shot)
    if kind in CLOUDS:
        meta = json.dumps({"format": "kitti"} if kind == "kitti" else {})
    for _ in range(rng.randint(1, 4)):
        data = _damage_bytes(data, rng)
    if rng.random() < 0.5:
        data = _with_checksums(data)
    return BrokenUpload(kind, data, meta)


def _with_checksums(data: bytes) -> bytes:
    """Return a damaged PNG with correct checksums, so that parsers continue."""
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


def _damage_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes with one random change."""
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


def _damage_json(text: str, rng: random.Random) -> str:
    """Return JSON with an invalid value or character."""
    if rng.random() < 0.5:
        metadata: dict[str, Any] = json.loads(text)
        place = metadata if rng.random() < 0.5 else metadata["intrinsics"]
        name = rng.choice([*place, "pose", "tags", "captured_at", "strange"])
        marked = {**place, name: "@@"}
        whole = marked if place is metadata else {**metadata, "intrinsics": marked}
        return json.dumps(whole).replace('"@@"', rng.choice(_TEXTS))
    return _damage_bytes(text.encode(), rng).decode("utf-8", "replace")


def send_broken(
    url: str, key: str, parts: Sequence[Part], shots: list[Shot], n: int, seed: int
) -> BrokenFigures:
    """Send broken uploads to a service with the map `siege`, and monitor the processes.

    Parameters
    ----------
    url, key : address of the service, and key
    parts : services and workers
    shots : frames to damage
    n : number of uploads
    """
    before = {pid for part in parts for pid in [part.pid, *part.children()]}
    statuses: Counter[int] = Counter()
    sent: Counter[str] = Counter()
    failed: list[str] = []
    lock, start = threading.Lock(), time.perf_counter()

    def send(number: int) -> None:
        upload = damaged_upload(shots, seed, number)
        try:
            status, text = _send(client, upload, number)
        except httpx.HTTPError as error:
            status, text = 0, repr(error)
        with lock:
            bar.update()
            sent[upload.kind] += 1
            statuses[status] += 1
            if status == 0 or (status >= 500 and status != 503):
                failed.append(f"upload {number} of {upload.kind}: {status} {text[-2000:]}")

    bar = tqdm(total=n, desc="broken uploads", disable=None, leave=False)
    client = httpx.Client(base_url=url, timeout=60, trust_env=False, headers=bearer(key))
    with bar, client, ThreadPoolExecutor(4) as pool:  # the client is safe to share
        list(pool.map(send, range(n)))
    ended = before - {pid for pid, _, _ in running_processes()}
    return BrokenFigures(
        dict(sent), dict(sorted(statuses.items())), failed, len(ended),
        max(part.peak_bytes() for part in parts), time.perf_counter() - start,
    )  # fmt: skip


def _send(client: httpx.Client, upload: BrokenUpload, number: int) -> tuple[int, str]:
    if upload.kind in ARCHIVES:
        kind = "application/zip" if upload.kind == "zip" else "application/gzip"
        answer = client.post(
            "/v1/maps/siege/imports", content=upload.data, headers={"Content-Type": kind}
        )
        return answer.status_code, answer.text
    # Uploads and queries both read the file.
    answer = client.post(
        f"/v1/maps/siege/{'frames' if number % 2 else 'queries'}",
        files={"frame": ("frame", upload.data, "application/octet-stream")},
        data={"meta": upload.meta},
    )
    return answer.status_code, answer.text


def broken_table(figures: BrokenFigures) -> list[str]:
    """Return the figures as lines of Markdown."""
    kinds = ", ".join(f"{n} {kind}" for kind, n in sorted(figures.sent.items()))
    answers = ", ".join(f"{n} of {status}" for status, n in figures.statuses.items())
    return [
        f"### {sum(figures.sent.values())} broken uploads in {figures.seconds:.0f} s", "",
        "| | |", "|---|--:|", f"| files | {kinds} |", f"| answers | {answers} |",
        f"| **5xx, or no answer** | **{len(figures.failed)}** |",
        f"| **processes that ended** | **{figures.crashed}** |",
        f"| most memory of a process, decoders too | {figures.peak_bytes / 2**20:.0f} MiB |", "",
    ]  # fmt: skip
