"""Files of a cache folder, each named by the SHA-256 of what it holds, the folder's lock, and the
manifests that say which segments a generation consists of, and each segment of which files.

A name that is the checksum needs no second place to keep it: a manifest that lists names lists
checksums, a file that two generations share is one file, and no file ever changes.
"""

from __future__ import annotations

import errno
import hashlib
import json
import mmap
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import (
    create_private,
    sync_folder,
    write_durable,
)
from sceneprint.errors import DamagedIndex
from sceneprint.types import Bytes

#: Endings of the files of a segment: its keys, FAISS indexes of its signatures and of their
#: sketches, the means by which those were made, and the deleted keys.
KINDS = ("keys", "faiss", "sketches", "means", "gone")
#: Bytes that are read at once where a file is checked.
BLOCK_BYTES = 8 << 20
_NAME = re.compile(rf"[0-9a-f]{{64}}\.({'|'.join(KINDS)})")
#: What a killed builder left.
_LEFT = re.compile(r"\.[0-9a-f]{12}\.part")


def is_name(name: str, kind: str) -> bool:
    """Whether a file of this kind can have this name: nothing else is opened."""
    found = _NAME.fullmatch(name)
    return found is not None and found[1] == kind


def is_file_name(name: str) -> bool:
    """Whether a file of a generation can have this name: it is in no other folder."""
    return _NAME.fullmatch(name) is not None


def is_ours(name: str) -> bool:
    """Whether a file was made here, and may be removed where no manifest needs it."""
    return bool(_NAME.fullmatch(name) or _LEFT.fullmatch(name))


def unfinished(folder: Path) -> Path:
    """A new name for a file that is not yet whole; `is_ours` knows it."""
    return folder / f".{secrets.token_hex(6)}.part"


def put(
    folder: Path, kind: str, write: Callable[[Callable[[bytes], None]], object]
) -> tuple[str, int]:
    """Write a file durably under the name that its bytes give.

    Parameters
    ----------
    folder : must exist
    kind : one of KINDS
    write : is called with what takes the bytes of the file, one block after the other

    Returns
    -------
    the name, and how many bytes it has

    Raises
    ------
    OSError : it cannot be written; nothing is left behind.
    """
    part, digest = unfinished(folder), hashlib.sha256()
    try:
        with os.fdopen(create_private(part), "wb") as file:

            def take(data: bytes) -> None:
                file.write(data)
                digest.update(data)

            write(take)
            size = file.tell()
            file.flush()
            os.fsync(file.fileno())  # before its name: a name must never lead to half a file
        name = f"{digest.hexdigest()}.{kind}"
        os.replace(part, folder / name)  # noqa: PTH105  (the one call that is atomic by contract)
        sync_folder(folder)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return name, size


def bytes_of(folder: Path) -> int:
    """Return the bytes of all files below a folder; files that are removed meanwhile count 0."""
    total = 0
    for path in folder.rglob("*"):
        with suppress(OSError):
            found = path.stat()
            total += found.st_size if stat.S_ISREG(found.st_mode) else 0
    return total


def check(folder: Path, name: str, size: int) -> Iterator[None]:
    """Read a file, and check that its bytes are those that its name was given for.

    Yields
    ------
    None after each block that was read, so that the caller may stop in between

    Raises
    ------
    DamagedIndex : missing, unreadable, of another size, or with bytes that give another name.
    """
    path, digest, made = folder / name, name.partition(".")[0], hashlib.sha256()
    try:
        with path.open("rb") as file:
            found = os.fstat(file.fileno()).st_size
            if found != size:
                raise DamagedIndex(f"{path}: {found} bytes, where {size} were written.")
            while block := file.read(BLOCK_BYTES):
                made.update(block)
                yield
    except OSError as error:
        raise DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).") from error
    if made.hexdigest() != digest:
        raise DamagedIndex(f"{path}: its bytes are not those that were written.")


def mapped(path: Path) -> mmap.mmap | bytes:
    """A file in memory that processes share, also after it is unlinked.

    Raises
    ------
    DamagedIndex : missing or unreadable.
    """
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                return b""
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).") from error


# Keys of frames, and where they stand in a list of keys.

Keys = NDArray[np.int64]
#: Keys (n,) int64 of frames, and their signatures (n, D) uint8.
Block = tuple[Keys, Bytes]


def check_block(keys: Keys, signatures: Bytes, length: int) -> None:
    """See that these are keys and signatures of that many bytes.

    Raises
    ------
    ValueError : they are not.
    """
    if keys.dtype != np.int64 or signatures.dtype != np.uint8:
        raise ValueError(f"keys of {keys.dtype} and signatures of {signatures.dtype}")
    if keys.ndim != 1 or length < 1 or signatures.shape != (len(keys), length):
        raise ValueError(f"keys {keys.shape} and signatures {signatures.shape} of {length} bytes")


def draw(n: int, limit: int, seed: int) -> NDArray[np.int64]:
    """At most `limit` of n rows: one at random from each of as many equal stretches.

    Even, so that every place of a map counts alike; at random, so that nothing periodic in the
    order of the frames (two robots in turn) is missed.
    """
    if n <= limit:
        return np.arange(n)
    edges = np.arange(limit + 1) * n // limit
    return np.random.default_rng(seed).integers(edges[:-1], edges[1:])


# Manifests: what a generation consists of. It exists from the moment its manifest has its name.
#
# A manifest is JSON, called by the number of the generation and the SHA-256 of its own bytes. Each
# schema has folders of its own, here and in an object store: two versions of the product beside
# each other neither read nor remove what the other made.

#: Of the files of a generation and of what they mean. Raise it when either changes.
SCHEMA_VERSION = 1
#: A manifest names five files of each segment at most; a larger file is refused unread.
MAXIMUM_BYTES = 1 << 16
_MANIFEST = re.compile(r"(\d{10})-([0-9a-f]{32})\.json")


@dataclass(frozen=True)
class Recall:
    """What a search of a segment, or of a generation, finds.

    Parameters
    ----------
    share : of the `near` nearest by the exact scan that a search finds too
    near : neighbours that were looked for
    sample : frames that were looked up, each without itself; 0 where a search compares every
        frame, so that there is nothing to miss
    probes : frames that a search compares at least, selected by their sketches; 0 where there are
        no sketches
    frames : that were measured
    """

    share: float
    near: int
    sample: int
    probes: int
    frames: int


@dataclass(frozen=True)
class SegmentFiles:
    """What a segment consists of.

    Parameters
    ----------
    files : (name, bytes) of its keys, of the FAISS index of their signatures, of their sketches
        and the means, if there are any, and of the keys that count no longer, if there are any
    recall : as measured when it was written
    """

    files: tuple[tuple[str, int], ...]
    recall: Recall

    @property
    def frames(self) -> int:
        """How many of its frames count."""
        sizes = {kind: 0 if (one := self.file(kind)) is None else one[1] for kind in KINDS}
        return (sizes["keys"] - sizes["gone"]) // 8

    def file(self, kind: str) -> tuple[str, int] | None:
        """The file of a kind, by name and bytes; None where there is none."""
        return next((each for each in self.files if is_name(each[0], kind)), None)


@dataclass(frozen=True)
class GenerationManifest:
    """What a generation consists of.

    Parameters
    ----------
    revision : of the map, up to which the generation holds its frames
    model_id : of the model that signed them
    dimension : D, bytes of a signature
    anchor : what whoever published it will know the state of the database by
    segments : that together hold each frame once; a frame counts in one of them only
    """

    number: int
    revision: int
    model_id: str
    dimension: int
    anchor: str
    segments: tuple[SegmentFiles, ...]

    @property
    def files(self) -> tuple[tuple[str, int], ...]:
        """(name, bytes) of every file, each once; a name is a checksum."""
        return tuple(dict.fromkeys(each for one in self.segments for each in one.files))

    @property
    def frames(self) -> int:
        """How many it holds."""
        return sum(one.frames for one in self.segments)

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the files of the keys, of those too that count no longer."""
        return tuple(name for name, _ in self.files if is_name(name, "keys"))

    @property
    def worn_keys(self) -> tuple[str, ...]:
        """Names of the files of the keys of those segments of which some frames are gone."""
        return tuple(one.files[0][0] for one in self.segments if one.file("gone") is not None)

    @property
    def recall(self) -> Recall:
        """What a search finds: the least of its segments."""
        each = [one.recall for one in self.segments]
        return Recall(
            share=min((one.share for one in each), default=1.0),
            near=max((one.near for one in each), default=0),
            sample=sum(one.sample for one in each),
            probes=sum(one.probes for one in each),
            frames=sum(one.frames for one in each),
        )


def manifests(folder: Path) -> list[tuple[int, Path]]:
    """Number and path of every manifest in a folder, sound or not, the newest first."""
    try:
        found = [(_MANIFEST.fullmatch(path.name), path) for path in folder.iterdir()]
    except OSError:  # a cache that cannot be read is none
        return []
    return sorted(((int(name[1]), path) for name, path in found if name), reverse=True)


def newest_number(folder: Path) -> int | None:
    """Number of the newest manifest in a folder, sound or not: a cheap sign of something new."""
    return next((number for number, _ in manifests(folder)), None)


def write_manifest(folder: Path, manifest: GenerationManifest) -> Path:
    """Write a manifest durably, last of all: everything it names must be there.

    Raises
    ------
    OSError : it cannot be written.
    """
    path = folder / manifest_name(manifest)
    write_durable(path, encode_manifest(manifest))
    return path


def encode_manifest(manifest: GenerationManifest) -> bytes:
    """A manifest as bytes; the same manifest gives the same."""
    record = {"schema_version": SCHEMA_VERSION} | asdict(manifest)
    return (json.dumps(record, indent=1) + "\n").encode()


def manifest_name(manifest: GenerationManifest) -> str:
    """The name of a manifest in a folder."""
    digest = hashlib.sha256(encode_manifest(manifest)).hexdigest()[:32]
    return f"{manifest.number:010d}-{digest}.json"


def read_manifest(path: Path) -> GenerationManifest:
    """Read a manifest, checked against its name.

    Raises
    ------
    DamagedIndex : missing, unreadable, changed, or of another schema.
    """
    found = _MANIFEST.fullmatch(path.name)
    try:
        data = path.read_bytes() if path.stat().st_size <= MAXIMUM_BYTES else b""
    except OSError as error:
        raise DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).") from error
    if found is None or hashlib.sha256(data).hexdigest()[:32] != found[2]:
        raise DamagedIndex(f"{path}: its bytes are not those that were written.")
    return decode_manifest(path, data)


def decode_manifest(path: Path, data: bytes) -> GenerationManifest:
    """A manifest from its bytes.

    Parameters
    ----------
    path : to show
    data : of `encode_manifest`

    Raises
    ------
    DamagedIndex : they are none, or of another schema.
    """
    try:
        record: dict[str, Any] = json.loads(data)
        if record.pop("schema_version") != SCHEMA_VERSION:
            raise DamagedIndex(f"{path}: of another schema than {SCHEMA_VERSION}.")
        record["segments"] = tuple(_decode_segment(**each) for each in record["segments"])
        manifest = GenerationManifest(**record)
    except (ValueError, TypeError, KeyError) as error:
        raise DamagedIndex(f"{path}: no manifest ({error}).") from error
    for one in manifest.segments:
        kinds = [kind for kind in KINDS if one.file(kind) is not None]
        if len(kinds) != len(one.files) or kinds[:2] != ["keys", "faiss"]:
            raise DamagedIndex(f"{path}: names files that no segment has.")
    return manifest


def _decode_segment(files: list[list[Any]], recall: dict[str, Any]) -> SegmentFiles:
    return SegmentFiles(tuple((str(name), int(size)) for name, size in files), Recall(**recall))


def scrub(folder: Path) -> Iterator[Path | None]:
    """Verify all files of the newest readable manifest of a folder.

    Yields
    ------
    None after each block that was read, so that the caller may stop in between; the path of a file
    that is damaged or missing, once
    """
    for _, path in manifests(folder):
        try:
            manifest = read_manifest(path)
        except DamagedIndex as error:  # an older one is used in its place meanwhile
            yield path if _is_lasting(error) and path.exists() else None
            continue
        for name, size in manifest.files:
            try:
                yield from check(folder, name, size)
            except DamagedIndex as error:
                if not _is_lasting(error) or not path.exists():
                    return  # out of reach, or a builder has replaced the generation meanwhile
                yield folder / name
        return


def _is_lasting(error: DamagedIndex) -> bool:
    """Whether a file is damaged or missing, and not merely out of reach for the moment."""
    cause = error.__cause__
    return not isinstance(cause, OSError) or cause.errno in (errno.ENOENT, errno.EIO)
