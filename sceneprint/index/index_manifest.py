"""Manifests of indexes: lists of the segments of a version and of their parts.

    NUMBER.json    manifest of a version, written after all of its parts

Folders and object stores use the same names for manifests and parts. Each schema has its own
folders, so that different versions of sceneprint do not affect each other's indexes.
"""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from sceneprint.atomic_files import write_durable
from sceneprint.errors import DamagedIndex
from sceneprint.index.part_files import KINDS, PART_NAME, unreadable, verify
from sceneprint.sealed_record import StrictRecord, seal, unseal

#: Version of the format of manifests and parts; raise it when the format changes.
SCHEMA_VERSION = 2
#: Maximum size of a manifest in bytes; larger files are not read.
MAXIMUM_BYTES = 1 << 16
_MANIFEST = re.compile(r"(\d{10})\.json")

#: Name and size in bytes of a part.
PartOfIndex = tuple[Annotated[str, Field(pattern=PART_NAME)], Annotated[int, Field(ge=0)]]


class Recall(StrictRecord):
    """The recall of searches in a segment or a whole index.

    Parameters
    ----------
    share : share of the `near` exact nearest neighbours that a search finds
    near : number of neighbours
    sample : number of frames used as queries, each excluded from its own results; 0 if searches
        compare all frames
    probes : minimum number of frames that sketches select for a search; 0 without sketches
    frames : number of frames at the time of the measurement
    """

    share: float
    near: int
    sample: int
    probes: int
    frames: int


class SegmentFiles(StrictRecord):
    """The parts of a segment.

    Parameters
    ----------
    files : parts: keys, FAISS index, and optionally sketches, means and removed keys
    recall : recall, measured when the segment was written
    """

    files: tuple[PartOfIndex, ...]
    recall: Recall

    @model_validator(mode="after")
    def _has_its_kinds(self) -> SegmentFiles:
        kinds = [kind for kind in KINDS if self.file(kind) is not None]
        if len(kinds) != len(self.files) or kinds[:2] != ["keys", "faiss"]:
            raise ValueError("the files of a segment are not complete")
        return self

    @property
    def frames(self) -> int:
        """Return the number of frames in the segment that were not removed."""
        keys, gone = self.file("keys"), self.file("gone")
        return ((0 if keys is None else keys[1]) - (0 if gone is None else gone[1])) // 8

    def file(self, kind: str) -> PartOfIndex | None:
        """Return the part of a kind; None if there is none."""
        return next((part for part in self.files if part[0].endswith(f".{kind}")), None)


class IndexManifest(StrictRecord):
    """The manifest of a version of a map's index.

    Parameters
    ----------
    number : number of the version, larger than the previous number
    revision : revision of the map up to which the index contains its frames
    model_id : id of the model that signed the frames
    dimension : D, length of a signature in bytes
    anchor : text by which the publisher recognises the state of the database
    segments : segments that together contain each frame once
    """

    schema_version: Annotated[int, Field(ge=SCHEMA_VERSION, le=SCHEMA_VERSION)] = SCHEMA_VERSION
    number: int
    revision: int
    model_id: str
    dimension: int
    anchor: str
    segments: tuple[SegmentFiles, ...]

    @property
    def name(self) -> str:
        """Return the name of the manifest in a folder or an object store."""
        return f"{self.number:010d}.json"

    @property
    def files(self) -> tuple[PartOfIndex, ...]:
        """Return all distinct parts."""
        return tuple(dict.fromkeys(part for segment in self.segments for part in segment.files))

    @property
    def frames(self) -> int:
        """Return the number of frames."""
        return sum(segment.frames for segment in self.segments)

    @property
    def keys(self) -> tuple[str, ...]:
        """Return the names of the parts with keys."""
        return tuple(name for name, _ in self.files if name.endswith(".keys"))

    @property
    def worn_keys(self) -> tuple[str, ...]:
        """Return the names of the key parts of segments from which frames were removed."""
        return tuple(
            segment.files[0][0] for segment in self.segments if segment.file("gone") is not None
        )

    @property
    def recall(self) -> Recall:
        """Return the recall of a search: the lowest share of any segment, and the totals of all."""
        recalls = [segment.recall for segment in self.segments]
        return Recall(
            share=min((recall.share for recall in recalls), default=1.0),
            near=max((recall.near for recall in recalls), default=0),
            sample=sum(recall.sample for recall in recalls),
            probes=sum(recall.probes for recall in recalls),
            frames=sum(recall.frames for recall in recalls),
        )


def manifest_number(name: str) -> int | None:
    """Return the number in the name of a manifest; None for other names."""
    match = _MANIFEST.fullmatch(name)
    return None if match is None else int(match[1])


def manifests(folder: Path) -> list[tuple[int, Path]]:
    """Return the numbers and paths of all manifests in a folder, even if damaged, newest first."""
    try:
        numbered = [(manifest_number(path.name), path) for path in folder.iterdir()]
    except OSError:  # an unreadable cache counts as empty
        return []
    return sorted(((number, path) for number, path in numbered if number is not None), reverse=True)


def newest_number(folder: Path) -> int | None:
    """Return the number of the newest manifest, even if damaged; None if there is none."""
    return next((number for number, _ in manifests(folder)), None)


def write_manifest(folder: Path, manifest: IndexManifest) -> Path:
    """Write a manifest durably; all of its parts must exist."""
    path = folder / manifest.name
    write_durable(path, seal(manifest))
    return path


def read_manifest(path: Path) -> IndexManifest:
    """Read a manifest; raise DamagedIndex if it is missing, unreadable or damaged."""
    try:
        data = path.read_bytes() if path.stat().st_size <= MAXIMUM_BYTES else b""
    except OSError as error:
        raise unreadable(path, error) from error
    return decode_manifest(path.name, data, str(path))


def decode_manifest(name: str, data: bytes, place: str) -> IndexManifest:
    """Parse a manifest.

    Parameters
    ----------
    name : name of its file or object
    place : path or key for errors

    Raises
    ------
    DamagedIndex : If the manifest is damaged, or has another schema or number.
    """
    try:
        manifest = IndexManifest.model_validate_json(json.dumps(unseal(data)))
    except (ValueError, RecursionError) as error:
        reason = str(error).partition("\n")[0]
        raise DamagedIndex(f"{place}: the manifest is damaged ({reason}).") from error
    if manifest.name != name:
        raise DamagedIndex(f"{place}: the manifest has another number, {manifest.number}.")
    return manifest


def scrub(folder: Path) -> Iterator[Path | None]:
    """Verify all parts of the newest readable manifest of a folder.

    Yields
    ------
    path : None after each block, so that the caller may pause; or the path of a damaged or missing
        file
    """
    for _, path in manifests(folder):
        try:
            manifest = read_manifest(path)
        except DamagedIndex as error:  # readers use an older version
            yield path if _is_lasting(error) and path.exists() else None
            continue
        for name, size in manifest.files:
            try:
                yield from verify(folder, name, size)
            except DamagedIndex as error:
                if not _is_lasting(error) or not path.exists():
                    return  # temporarily unreadable, or replaced by a builder
                yield folder / name
        return


def _is_lasting(error: DamagedIndex) -> bool:
    """Return whether an error persists, unlike the error of a temporarily unreadable file."""
    cause = error.__cause__
    return not isinstance(cause, OSError) or cause.errno in (errno.ENOENT, errno.EIO)
