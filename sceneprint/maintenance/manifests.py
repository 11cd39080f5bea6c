"""The manifest of a snapshot: what is in it, and the checksums of what does not name its own.

manifest.json   this; as many bytes as MANIFEST_BYTES, so that it can be written last
sceneprint.db   the database, SQLite, in one file
blobs/DIGEST    every blob it refers to, ordered by digest, which is the SHA-256 of the content
damaged.jsonl   the blobs that were missing or damaged when it was taken, and whose they are
"""

from __future__ import annotations

import hashlib
import json
from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sceneprint.errors import DamagedSnapshot, SnapshotError

#: Of the archive and of what it means. Raise it when either changes.
VERSION = 1
MANIFEST_BYTES = 2048
#: Most bytes of a manifest that are read, of whatever version.
LONGEST = 1 << 20
MANIFEST, DATABASE, DAMAGED, BLOBS = (
    "manifest.json", "sceneprint.db", "damaged.jsonl", "blobs/",
)  # fmt: skip


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Member(_Record):
    """A member that does not name its own checksum."""

    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class Blobs(_Record):
    """All blobs together."""

    count: int = Field(ge=0)
    bytes: int = Field(ge=0)


class Damaged(Member):
    """The list of what could not be taken along."""

    count: int = Field(ge=0)


class Use(_Record):
    """What a blob is for."""

    map: str
    frame: str | None = None
    job: str | None = None
    role: Literal["upload", "geometry", "job"]


class LostBlob(_Record):
    """A line of `damaged.jsonl`: a blob that could not be taken along."""

    digest: str
    why: Literal["missing", "damaged"]
    of: tuple[Use, ...]


class Manifest(_Record):
    """What is in a snapshot."""

    format: Literal["sceneprint-snapshot"] = "sceneprint-snapshot"
    version: Literal[1] = 1
    #: When it was begun; its state is not older.
    created_at: datetime
    #: The version that wrote it.
    sceneprint: str
    #: Of the database.
    schema_revision: str
    maps: int
    #: How many are in each state.
    frames: dict[str, int]
    signatures: int
    database: Member
    blobs: Blobs
    damaged: Damaged
    #: Of the archive.
    bytes: int

    @property
    def n_frames(self) -> int:
        """Frames that are kept, in whatever state."""
        return sum(n for state, n in self.frames.items() if state != "deleted")


def manifest_bytes(manifest: Manifest) -> bytes:
    """A manifest as the member of that name: JSON with a checksum of itself, filled with blanks.

    Raises
    ------
    ValueError : it is longer than the place that is kept for it.
    """
    record: dict[str, Any] = json.loads(manifest.model_dump_json())
    text = json.dumps(record | {"sha256": _checksum(record)}, indent=1).encode()
    if len(text) >= MANIFEST_BYTES:
        raise ValueError(f"the manifest has {len(text)} bytes, and room for {MANIFEST_BYTES - 1}")
    return text.ljust(MANIFEST_BYTES - 1) + b"\n"


def read_manifest(data: bytes, place: str) -> Manifest:
    """A manifest from its bytes.

    Parameters
    ----------
    data : of the member
    place : of the archive, for messages

    Raises
    ------
    DamagedSnapshot : no snapshot, or damaged.
    SnapshotError : of a later version.
    """
    try:
        record = json.loads(data)
        if not isinstance(record, dict) or record.get("format") != "sceneprint-snapshot":
            raise ValueError("of another format")
        checksum = record.pop("sha256", None)
        if checksum != _checksum(record):
            raise ValueError("its checksum does not fit")
        version = record.get("version")
        if version != VERSION:
            raise SnapshotError(
                f"{place}: a snapshot of version {version!r:.20}, and this sceneprint reads "
                f"{VERSION}. Restore it with the sceneprint that took it."
            )
        return Manifest.model_validate_json(json.dumps(record))
    except (ValueError, ValidationError, RecursionError) as error:
        raise DamagedSnapshot(
            f"{place}: no snapshot of sceneprint, or its manifest is damaged "
            f"({str(error).partition(chr(10))[0]}). Take another, or another copy of it."
        ) from error


def _checksum(record: dict[str, Any]) -> str:
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
