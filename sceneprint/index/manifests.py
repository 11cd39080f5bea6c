"""Manifests: what a generation consists of. It exists from the moment its manifest has its name.

A manifest is JSON, called by the number of the generation and the SHA-256 of its own bytes.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sceneprint.errors import DamagedIndex
from sceneprint.index.files import KINDS, is_name
from sceneprint.writing import write_durable

#: Of the files of a generation and of what they mean. Raise it when either changes.
SCHEMA_VERSION = 1
#: A manifest names a few hundred files at most; a larger file is refused unread.
MAXIMUM_BYTES = 1 << 20
_NAME = re.compile(r"(\d{10})-([0-9a-f]{32})\.json")


@dataclass(frozen=True)
class Recall:
    """What the shortlist finds of the nearest frames.

    Parameters
    ----------
    share : of the `near` nearest by the exact scan that the shortlist finds too
    near : neighbours that were looked for
    sample : frames that were looked up, each without itself; 0 where a search compares every
        frame, so that there is nothing to miss
    shortlist : frames that the codes propose
    frames : of the generation that was measured, which may be an earlier one
    """

    share: float
    near: int
    sample: int
    shortlist: int
    frames: int


@dataclass(frozen=True)
class Manifest:
    """What a generation consists of.

    Parameters
    ----------
    number : of the generation
    revision : of the map, up to which the generation holds its frames
    model_id : of the model that signed them
    dimension : D, bytes of a signature
    code_id : of the code
    fitted_on : frames that the map had when the code was fitted
    anchor : what whoever published it will know the state of the database by
    files : (name, bytes) of every file, segments in the order of their rows; a name is a checksum
    recall : as measured when it, or one before it that had about as many frames, was published;
        None where an earlier version published it
    """

    number: int
    revision: int
    model_id: str
    dimension: int
    code_id: str
    fitted_on: int
    anchor: str
    files: tuple[tuple[str, int], ...]
    recall: Recall | None = None

    def of_kind(self, kind: str) -> list[tuple[str, int]]:
        """The files of one kind."""
        return [(name, size) for name, size in self.files if is_name(name, kind)]


def manifests(folder: Path) -> list[tuple[int, Path]]:
    """Number and path of every manifest in a folder, sound or not, the newest first."""
    try:
        found = [(_NAME.fullmatch(path.name), path) for path in folder.iterdir()]
    except OSError:  # a cache that cannot be read is none
        return []
    return sorted(((int(name[1]), path) for name, path in found if name), reverse=True)


def write_manifest(folder: Path, manifest: Manifest) -> Path:
    """Write a manifest durably, last of all: everything it names must be there.

    Raises
    ------
    OSError : it cannot be written.
    """
    record = {"schema_version": SCHEMA_VERSION} | asdict(manifest)
    data = (json.dumps(record, indent=1) + "\n").encode()
    path = folder / f"{manifest.number:010d}-{hashlib.sha256(data).hexdigest()[:32]}.json"
    write_durable(path, data)
    return path


def read_manifest(path: Path) -> Manifest:
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
        record["recall"] = _recall(record.get("recall"))
        manifest = Manifest(**record)
    except (ValueError, TypeError, KeyError) as error:  # of another version, if of any
        raise DamagedIndex(f"{path}: no manifest ({error}).") from error
    if not all(any(is_name(name, kind) for kind in KINDS) for name, _ in manifest.files) or any(
        len(manifest.of_kind(kind)) != 1 for kind in KINDS if kind != "segment"
    ):
        raise DamagedIndex(f"{path}: names files that no generation has.")
    return manifest


def _recall(told: dict[str, Any] | None) -> Recall | None:
    """None where nothing was measured, or otherwise than now: no search depends on it."""
    try:
        return None if told is None else Recall(**told)
    except TypeError:
        return None
