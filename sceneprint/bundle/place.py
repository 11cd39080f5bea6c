"""Places of bundles: folders or object stores with manifests and the parts that they list.

    PLACE/place.json            name of the store that owns the bundles
    PLACE/bundles/NAME.json     a manifest, written after all of its parts
    PLACE/parts/ab/SHA256       a part, named by the SHA-256 of its bytes

Parts never change, and bundles share identical parts, so a bundle adds only what changed since the
previous bundle. A killed writer leaves earlier bundles intact; a later `prune` removes its parts.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import BinaryIO, Literal
from urllib.parse import quote

from pydantic import Field

from sceneprint.atomic_files import folder_turn, make_folder
from sceneprint.errors import BundleError, DamagedBundle
from sceneprint.sealed_record import StrictRecord, seal, unseal
from sceneprint.store.blobs.folder import Condition, is_digest
from sceneprint.store.blobs.object_client import Objects, open_objects

_MARK, _BUNDLES, _PARTS = "place.json", "bundles/", "parts/"
_NAME = re.compile(r"bundles/(\d{8}T\d{6}-\d{6}Z)\.json")
#: Maximum size of a manifest, in bytes: enough for about ten million frames.
LONGEST = 1 << 27
#: Age, in seconds, at which unlisted parts are removed; a backup in progress may list newer parts.
GRACE_S = 86_400.0


class Part(StrictRecord):
    """A part of a bundle.

    Parameters
    ----------
    kind : `rows/TABLE`, or `blobs` for a list of blobs; the blobs are parts too
    digest : SHA-256 of the part's bytes; it names the part
    source : digest of the rows before their encoding
    """

    kind: str = Field(pattern=r"^(rows/[a-z_]{1,63}|blobs)$")
    digest: str = Field(pattern="^[0-9a-f]{64}$")
    bytes: int = Field(ge=0)
    rows: int = Field(ge=0)
    source: str = Field(pattern="^[0-9a-f]{64}$")


class BundleManifest(StrictRecord):
    """The manifest of a bundle.

    Parameters
    ----------
    created_at : start of the backup; the bundle contains all earlier changes
    sceneprint, schema_revision : version and schema of the store that wrote the bundle
    maps, signatures, blobs : numbers of maps, signatures and blobs
    frames : number of frames by state
    lost : number of blobs that were missing or damaged in the store
    blob_bytes : total size of the blobs
    numbers : last row number that was assigned in each table
    parts : parts with rows and parts with lists of blobs, each kind in the order of the rows' keys
    """

    format: Literal["sceneprint-bundle"] = "sceneprint-bundle"
    version: Literal[1] = 1
    created_at: datetime
    sceneprint: str
    schema_revision: str
    maps: int = Field(ge=0)
    frames: dict[str, int]
    signatures: int = Field(ge=0)
    blobs: int = Field(ge=0)
    lost: int = Field(ge=0)
    blob_bytes: int = Field(ge=0)
    numbers: dict[str, int]
    parts: tuple[Part, ...]

    @property
    def name(self) -> str:
        """Return the name of the bundle; names sort by time."""
        return f"{self.created_at:%Y%m%dT%H%M%S-%f}Z"

    @property
    def n_frames(self) -> int:
        """Return the number of frames that are not deleted."""
        return sum(n for state, n in self.frames.items() if state != "deleted")

    @property
    def bytes(self) -> int:
        """Return the size of all parts, including parts that other bundles share."""
        return self.blob_bytes + sum(part.bytes for part in self.parts)


class BundlePlace:
    """A folder or an object store with bundles. Threads may share an instance.

    Every method raises UnusableStore if the place cannot be used.
    """

    def __init__(self, objects: Objects, folder: Path | None) -> None:
        self._objects, self._folder = objects, folder
        #: Address without credentials, for messages
        self.shown = str(folder) if folder is not None else objects.url
        self._sizes = cache(self._list_sizes)

    @classmethod
    def open(cls, place: str, *, create: bool = False) -> BundlePlace:
        """Open a folder or an object store.

        Parameters
        ----------
        place : path of a folder, or URL of an object store; see `open_objects`
        create : whether to create a missing folder

        Raises
        ------
        BundleError : If the folder does not exist, or the path is not a folder.
        UnusableStore : If the URL does not name an object store.
        """
        if "://" in place:
            return cls(open_objects(place, "the location of the bundles"), None)
        folder = Path(os.path.realpath(place))
        if not create and not folder.is_dir():
            raise BundleError(
                f"{place}: the folder does not exist. Pass the location of the bundles."
            )
        if folder.exists() and not folder.is_dir():
            raise BundleError(f"{place} is not a folder. Pass another location for the bundles.")
        if create:
            make_folder(folder)
        url = f"file://{quote(str(folder))}"
        return cls(open_objects(url, "the location of the bundles"), folder)

    def claim(self, owner: str) -> None:
        """Mark the place as owned by a store, and create its folders.

        Raises
        ------
        BundleError : If the place holds bundles of another store, or other files.
        """
        data = json.dumps({"format": "sceneprint-place", "store": owner}).encode()
        if self._objects.put(_MARK, data, create=True):
            ours = (_MARK, _BUNDLES, _PARTS, ".lock")
            others = (
                entry.key for entry in self._objects.list("") if not entry.key.startswith(ours)
            )
            other = next(others, None)
            if other is not None:
                self._objects.delete(_MARK)
                raise BundleError(
                    f"{self.shown} holds {other}, which is not part of a bundle. Pass an empty "
                    "location."
                )
        elif self._objects.get(_MARK) != data:
            raise BundleError(
                f"{self.shown} holds the bundles of another store. Use a separate location for "
                f"each store. If the other store no longer exists, remove {_MARK} there."
            )
        if self._folder is not None:
            for name in (_BUNDLES, _PARTS):  # private folders, because frames show rooms
                make_folder(self._folder / name)

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Lock the place for writing; object stores have no lock.

        Raises
        ------
        BundleError : If another process is writing to the folder.
        """
        if self._folder is None:
            yield
            return
        with folder_turn(self._folder) as mine:
            if not mine:
                raise BundleError(
                    f"{self.shown}: another process is writing a bundle there. Try again later."
                )
            yield

    def names(self) -> list[str]:
        """Return the names of all bundles, newest first."""
        matches = (_NAME.fullmatch(entry.key) for entry in self._objects.list(_BUNDLES))
        return sorted((match[1] for match in matches if match), reverse=True)

    def read(self, name: str | None = None) -> BundleManifest:
        """Read the manifest of a bundle, by default the newest.

        Raises
        ------
        BundleError : If the bundle does not exist, or another version of the format wrote it.
        DamagedBundle : If the manifest is damaged.
        """
        names = self.names()
        if not names or name not in (None, *names):
            shown = "" if name is None else f" {name!r:.80}"
            then = f"The newest are: {', '.join(names[:3])}." if names else "Pass another place."
            raise BundleError(f"{self.shown} holds no bundle{shown}. {then}")
        key = f"{_BUNDLES}{name or names[0]}.json"
        entry = self._objects.head(key)
        data = b"" if entry is None or entry.size > LONGEST else self._objects.get(key)
        return _decode_manifest(data, f"{self.shown}/{key}")

    def publish(self, manifest: BundleManifest) -> None:
        """Write a manifest. All of its parts must exist."""
        self._objects.put(f"{_BUNDLES}{manifest.name}.json", seal(manifest))

    def size(self, digest: str) -> int | None:
        """Return the size of a part in bytes; None if it is missing. Listings are cached."""
        return self._sizes(digest[:2]).get(digest)

    def put(self, data: bytes) -> tuple[str, bool]:
        """Write a part if it is missing; return its digest and whether it was written."""
        digest = hashlib.sha256(data).hexdigest()
        if self.size(digest) == len(data):
            return digest, False
        self._objects.put(_part_key(digest), data)
        return digest, True

    def put_file(self, digest: str, file: BinaryIO) -> None:
        """Write a large part from a file. The caller has checked its digest."""
        self._objects.put_file(_part_key(digest), file)

    def get(self, digest: str) -> bytes:
        """Return the bytes of a part; raise DamagedBundle if it is missing or damaged."""
        try:
            data = self._objects.get(_part_key(digest))
        except FileNotFoundError:
            raise self.damaged(digest, "is missing") from None
        if hashlib.sha256(data).hexdigest() != digest:
            raise self.damaged(digest, "is damaged")
        return data

    def chunks(self, digest: str) -> Iterator[bytes]:
        """Yield the bytes of a large part, unverified. Raise DamagedBundle if it is missing."""
        try:
            yield from self._objects.chunks(_part_key(digest))
        except FileNotFoundError:
            raise self.damaged(digest, "is missing") from None

    def condition(self, digest: str) -> Condition:
        """Read a part, and return its condition."""
        hashed = hashlib.sha256()
        try:
            for chunk in self._objects.chunks(_part_key(digest)):
                hashed.update(chunk)
        except FileNotFoundError:
            return "missing"
        return "sound" if hashed.hexdigest() == digest else "damaged"

    def damaged(self, digest: str, what: str) -> DamagedBundle:
        """Return the error for a damaged or missing part."""
        return DamagedBundle(
            f"{self.shown}: the part {_part_key(digest)} {what}. Restore another bundle, or remove "
            "this part and take a snapshot: it writes the part if the store still has its content."
        )

    def prune(self, needed: Collection[str], keep: int) -> int:
        """Remove old bundles, then unneeded parts older than GRACE_S; return the count of these.

        Parameters
        ----------
        needed : digests of all parts of the retained bundles
        keep : number of newest bundles to retain
        """
        self._objects.delete(*(f"{_BUNDLES}{name}.json" for name in self.names()[keep:]))
        before = time.time() - GRACE_S
        unneeded = [
            entry.key for entry in self._objects.list(_PARTS)
            if entry.changed_at < before and is_digest(name := entry.key.rpartition("/")[2])
            and name not in needed
        ]  # fmt: skip
        self._objects.delete(*unneeded)
        if self._folder is not None:  # unfinished files of a killed writer
            for path in self._folder.glob(f"{_PARTS}*/*#*"):
                if path.stat().st_mtime < before:
                    path.unlink(missing_ok=True)
        return len(unneeded)

    def _list_sizes(self, first: str) -> dict[str, int]:
        """Return the sizes of all parts whose digests start with two digits, by digest."""
        parts = self._objects.list(f"{_PARTS}{first}/")
        return {part.key.rpartition("/")[2]: part.size for part in parts}


def _part_key(digest: str) -> str:
    return f"{_PARTS}{digest[:2]}/{digest}"


def _decode_manifest(data: bytes, place: str) -> BundleManifest:
    """Parse a manifest. Raise BundleError for another version, DamagedBundle if it is damaged."""
    try:
        record = unseal(data)
        if record.get("format") != "sceneprint-bundle":
            raise ValueError("it has a different format")
        if record.get("version") != 1:
            raise BundleError(
                f"{place}: the bundle has version {record.get('version')!r:.20}, but this version "
                "of sceneprint reads version 1. Restore the bundle with the version that wrote it."
            )
        return BundleManifest.model_validate_json(json.dumps(record))
    except (ValueError, RecursionError) as error:
        raise DamagedBundle(
            f"{place}: the manifest of the bundle is damaged ({str(error).partition(chr(10))[0]}). "
            "Restore another bundle, or use another copy of this location."
        ) from error
