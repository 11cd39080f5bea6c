"""Manifests of an index: the segments that it consists of, and the parts of each.

    NUMBER.json    one published state of a map's index, written after all parts that it names

Folders and object stores hold them under the same names, beside their parts. Each schema has
folders of its own: two versions of the product beside each other neither read nor remove what the
other wrote.
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

#: Of the parts of an index and of what they mean. Raise it when either changes.
SCHEMA_VERSION = 2
#: A manifest names five parts of each segment at most; a larger file is refused unread.
MAXIMUM_BYTES = 1 << 16
_MANIFEST = re.compile(r"(\d{10})\.json")

#: The name of a part, and its bytes.
PartOfIndex = tuple[Annotated[str, Field(pattern=PART_NAME)], Annotated[int, Field(ge=0)]]


class Recall(StrictRecord):
    """What a search of a segment, or of a whole index, finds.

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


class SegmentFiles(StrictRecord):
    """The parts of a segment.

    Parameters
    ----------
    files : its keys, the FAISS index of their signatures, their sketches and the means, if there
        are any, and the keys that count no longer, if there are any
    recall : as measured when it was written
    """

    files: tuple[PartOfIndex, ...]
    recall: Recall

    @model_validator(mode="after")
    def _has_its_kinds(self) -> SegmentFiles:
        kinds = [kind for kind in KINDS if self.file(kind) is not None]
        if len(kinds) != len(self.files) or kinds[:2] != ["keys", "faiss"]:
            raise ValueError("names files that no segment has")
        return self

    @property
    def frames(self) -> int:
        """How many of its frames count."""
        keys, gone = self.file("keys"), self.file("gone")
        return ((0 if keys is None else keys[1]) - (0 if gone is None else gone[1])) // 8

    def file(self, kind: str) -> PartOfIndex | None:
        """Return the part of a kind; None where there is none."""
        return next((one for one in self.files if one[0].endswith(f".{kind}")), None)


class IndexManifest(StrictRecord):
    """One published state of a map's index.

    Parameters
    ----------
    number : larger than that of the state before
    revision : of the map, up to which the index holds its frames
    model_id : of the model that signed them
    dimension : D, bytes of a signature
    anchor : by which the publisher recognises the state of the database
    segments : that together hold each frame once; a frame counts in one of them only
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
        """Its name in a folder or an object store."""
        return f"{self.number:010d}.json"

    @property
    def files(self) -> tuple[PartOfIndex, ...]:
        """All parts, each once."""
        return tuple(dict.fromkeys(each for one in self.segments for each in one.files))

    @property
    def frames(self) -> int:
        """How many it holds."""
        return sum(one.frames for one in self.segments)

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the parts with keys, of those too that count no longer."""
        return tuple(name for name, _ in self.files if name.endswith(".keys"))

    @property
    def worn_keys(self) -> tuple[str, ...]:
        """Names of the parts with the keys of those segments of which some frames are gone."""
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


def manifest_number(name: str) -> int | None:
    """Return the number of a manifest by its name; None for any other name."""
    found = _MANIFEST.fullmatch(name)
    return None if found is None else int(found[1])


def manifests(folder: Path) -> list[tuple[int, Path]]:
    """Return number and path of every manifest in a folder, sound or not, the newest first."""
    try:
        found = [(manifest_number(path.name), path) for path in folder.iterdir()]
    except OSError:  # a cache that cannot be read is none
        return []
    return sorted(((number, path) for number, path in found if number is not None), reverse=True)


def newest_number(folder: Path) -> int | None:
    """Return the number of the newest manifest, sound or not: a cheap sign of something new."""
    return next((number for number, _ in manifests(folder)), None)


def write_manifest(folder: Path, manifest: IndexManifest) -> Path:
    """Write a manifest durably, after everything that it names."""
    path = folder / manifest.name
    write_durable(path, seal(manifest))
    return path


def read_manifest(path: Path) -> IndexManifest:
    """Read a manifest; DamagedIndex where it is missing, unreadable, changed, or another's."""
    try:
        data = path.read_bytes() if path.stat().st_size <= MAXIMUM_BYTES else b""
    except OSError as error:
        raise unreadable(path, error) from error
    return decode_manifest(path.name, data, str(path))


def decode_manifest(name: str, data: bytes, place: str) -> IndexManifest:
    """Return a manifest from its bytes.

    Parameters
    ----------
    name : under which it lies
    place : to show

    Raises
    ------
    DamagedIndex : they are none, changed, of another schema or number.
    """
    try:
        found = IndexManifest.model_validate_json(json.dumps(unseal(data)))
    except (ValueError, RecursionError) as error:
        said = str(error).partition("\n")[0]
        raise DamagedIndex(f"{place}: no manifest of an index, or damaged ({said}).") from error
    if found.name != name:
        raise DamagedIndex(f"{place}: the manifest of another number, {found.number}.")
    return found


def scrub(folder: Path) -> Iterator[Path | None]:
    """Verify all parts of the newest readable manifest of a folder.

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
                yield from verify(folder, name, size)
            except DamagedIndex as error:
                if not _is_lasting(error) or not path.exists():
                    return  # out of reach, or a builder has replaced it meanwhile
                yield folder / name
        return


def _is_lasting(error: DamagedIndex) -> bool:
    """Return whether a file is damaged or missing, and not merely out of reach for the moment."""
    cause = error.__cause__
    return not isinstance(cause, OSError) or cause.errno in (errno.ENOENT, errno.EIO)
