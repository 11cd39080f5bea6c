"""Manifests: what a generation consists of. It exists from the moment its manifest has its name.

A manifest is JSON, called by the number of the generation, the SHA-256 of its own bytes, and its
schema: those of another schema are nobody's, and the next builder removes them.
"""

from __future__ import annotations

import errno
import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sceneprint.atomic_files import write_durable
from sceneprint.errors import DamagedIndex
from sceneprint.index.mapped_files import KINDS, check, is_name

#: Of the files of a generation and of what they mean. Raise it when either changes.
SCHEMA_VERSION = 2
#: A manifest names three files at most; a larger file is refused unread.
MAXIMUM_BYTES = 1 << 16
_NAME = re.compile(rf"(\d{{10}})-([0-9a-f]{{32}})\.{SCHEMA_VERSION}\.json")


@dataclass(frozen=True)
class Recall:
    """What a search of a generation finds.

    Parameters
    ----------
    share : of the `near` nearest by the exact scan that a search finds too
    near : neighbours that were looked for
    sample : frames that were looked up, each without itself; 0 where a search compares every
        frame, so that there is nothing to miss
    probes : lists of the inverted file that a search compares; 0 where there is none
    frames : of the generation that was measured, which may be an earlier one
    """

    share: float
    near: int
    sample: int
    probes: int
    frames: int


@dataclass(frozen=True)
class GenerationManifest:
    """What a generation consists of.

    Parameters
    ----------
    number : of the generation
    revision : of the map, up to which the generation holds its frames
    model_id : of the model that signed them
    dimension : D, bytes of a signature
    anchor : what whoever published it will know the state of the database by
    files : (name, bytes) of every file; a name is a checksum
    recall : as measured when it, or one before it that had about as many frames, was published
    """

    number: int
    revision: int
    model_id: str
    dimension: int
    anchor: str
    files: tuple[tuple[str, int], ...]
    recall: Recall

    def file(self, kind: str) -> tuple[str, int] | None:
        """The file of a kind, by name and bytes; None where there is none."""
        return next((each for each in self.files if is_name(each[0], kind)), None)


def manifests(folder: Path) -> list[tuple[int, Path]]:
    """Number and path of every manifest in a folder, sound or not, the newest first."""
    try:
        found = [(_NAME.fullmatch(path.name), path) for path in folder.iterdir()]
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
    record = {"schema_version": SCHEMA_VERSION} | asdict(manifest)
    data = (json.dumps(record, indent=1) + "\n").encode()
    name = f"{manifest.number:010d}-{hashlib.sha256(data).hexdigest()[:32]}"
    path = folder / f"{name}.{SCHEMA_VERSION}.json"
    write_durable(path, data)
    return path


def read_manifest(path: Path) -> GenerationManifest:
    """Read a manifest, checked against its name.

    Raises
    ------
    DamagedIndex : missing, unreadable, changed, or of another schema.
    """
    found = _NAME.fullmatch(path.name)
    try:
        data = path.read_bytes() if path.stat().st_size <= MAXIMUM_BYTES else b""
    except OSError as error:
        raise DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).") from error
    if found is None or hashlib.sha256(data).hexdigest()[:32] != found[2]:
        raise DamagedIndex(f"{path}: its bytes are not those that were written.")
    try:
        record: dict[str, Any] = json.loads(data)
        if record.pop("schema_version") != SCHEMA_VERSION:
            raise DamagedIndex(f"{path}: of another schema than {SCHEMA_VERSION}.")
        record["files"] = tuple((str(name), int(size)) for name, size in record["files"])
        record["recall"] = Recall(**record["recall"])
        manifest = GenerationManifest(**record)
    except (ValueError, TypeError, KeyError) as error:
        raise DamagedIndex(f"{path}: no manifest ({error}).") from error
    kinds = [kind for kind in KINDS if manifest.file(kind) is not None]
    if len(kinds) != len(manifest.files) or kinds[:2] != ["keys", "faiss"]:
        raise DamagedIndex(f"{path}: names files that no generation has.")
    return manifest


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
