"""Uploads that are broken in every way: none may crash a process, fail with 5xx, or cost memory.

seed, number  --mutated-->  Upload  --besiege-->  MutationFigures
"""

from __future__ import annotations

import io
import json
import random
import tarfile
import threading
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from tqdm import tqdm

from benchmarks.soak.load import Part, Shot

#: Bytes that parsers of binary formats stumble over.
_WORDS = (
    b"\x00" * 4, b"\xff" * 4, b"\x7f\xff\xff\xff", b"\x80\x00\x00\x00", b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x01", b"IDAT", b"IEND", b"IHDR", b"PK\x03\x04", b"\x93NUMPY",
)  # fmt: skip
_TEXTS = (
    "null", "-1", "1e999", "NaN", "[]", "{}", '""', '"\\ud800"', "18446744073709551616", "true",
    "[" * 500, '{"a":' * 200, '"' + "x" * 5000 + '"',
)  # fmt: skip


@dataclass(frozen=True)
class Upload:
    """What is sent.

    Parameters
    ----------
    kind : of the file: png, npy, json (its metadata), zip or tar
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
    crashed : processes of the service that ended
    peak_bytes : most memory that one of them took
    seconds : in all
    """

    sent: dict[str, int]
    statuses: dict[int, int]
    failed: list[str]
    crashed: int
    peak_bytes: int
    seconds: float


def mutated(shots: list[Shot], seed: int, number: int) -> Upload:
    """The upload of a number: a sound one, broken in one to four places; the same each time."""
    rng = random.Random(f"{seed} {number}")
    shot = rng.choice(shots)
    kind = rng.choice(("png", "png", "npy", "json", "json", "zip", "tar"))
    meta = shot.meta.model_dump_json()
    if kind == "json":
        return Upload(kind, shot.png, _broken_text(meta, rng))
    data = _FILES[kind](shot)
    for _ in range(rng.randint(1, 4)):
        data = _broken(data, rng)
    return Upload(kind, data, meta)


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


def _npy(shot: Shot) -> bytes:
    out = io.BytesIO()
    k = shot.meta.intrinsics
    assert k is not None  # these are depth images
    np.save(out, np.linspace(1, 3, k.width * k.height, dtype=np.float32).reshape(k.height, -1))
    return out.getvalue()


def _zip(shot: Shot) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in _members(shot):
            # a time of its own would make other bytes every two seconds
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    return out.getvalue()


def _tar(shot: Shot) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as archive:
        for name, data in _members(shot):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return out.getvalue()


def _members(shot: Shot) -> list[tuple[str, bytes]]:
    k = shot.meta.intrinsics
    camera = {name: getattr(k, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return [
        ("room/seq-01/intrinsics.json", json.dumps(camera).encode()),
        ("room/seq-01/frame-000000.depth.png", shot.png),
        ("room/seq-01/frame-000001.depth.png", shot.png[:-30]),
    ]


_FILES: dict[str, Callable[[Shot], bytes]] = {
    "png": lambda shot: shot.png, "npy": _npy, "zip": _zip, "tar": _tar,
}  # fmt: skip


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
    statuses: Counter[int] = Counter()
    sent: Counter[str] = Counter()
    failed: list[str] = []
    lock = threading.Lock()
    start = time.perf_counter()
    bar = tqdm(total=n, desc="mutated uploads", disable=None, leave=False)

    def send(number: int) -> None:
        upload = mutated(shots, seed, number)
        try:
            status, text = _send(client, upload, number)
        except httpx.HTTPError as error:
            status, text = 0, repr(error)
        with lock:
            bar.update()
            sent[upload.kind] += 1
            statuses[status] += 1
            if status == 0 or (status >= 500 and status != 503):
                failed.append(f"upload {number} of {upload.kind}: {status} {text[:300]}")

    client = httpx.Client(base_url=url, timeout=60, trust_env=False)  # all threads may use it
    with bar, client, ThreadPoolExecutor(threads) as pool:
        list(pool.map(send, range(n)))
    seconds = time.perf_counter() - start
    after = {pid for part in parts for pid in [part.pid, *part.children()]}
    peak = max(_peak(pid) for pid in after)
    return MutationFigures(
        dict(sent), dict(sorted(statuses.items())), failed, len(before - after), peak, seconds
    )


def _send(client: httpx.Client, upload: Upload, number: int) -> tuple[int, str]:
    if upload.kind in ("zip", "tar"):
        kind = {"zip": "application/zip", "tar": "application/gzip"}[upload.kind]
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
