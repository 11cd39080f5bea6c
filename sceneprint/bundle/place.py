"""Places of bundles: a folder or an object store that holds manifests and the parts they name.

    PLACE/place.json            the store whose bundles these are
    PLACE/bundles/NAME.json     a manifest, written after all parts that it names
    PLACE/parts/ab/SHA256       a part, under the SHA-256 of its bytes

A part never changes, and bundles share the parts that are the same, so a bundle costs what is new
since the one before. A writer that dies at any moment leaves the bundles that were there, and parts
that a later `prune` removes.
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
from sceneprint.errors import BundleError, DamagedBundle, UnusableStore
from sceneprint.sealed_record import StrictRecord, seal, unseal
from sceneprint.store.blobs.folder import Condition, is_digest
from sceneprint.store.blobs.object_client import Objects, open_objects

_MARK, _BUNDLES, _PARTS = "place.json", "bundles/", "parts/"
_NAME = re.compile(r"bundles/(\d{8}T\d{6}-\d{6}Z)\.json")
#: Bytes of the longest manifest that is read: of a store of some ten million frames.
LONGEST = 1 << 27
#: Seconds for which a part that no bundle names is kept: it may be of a bundle that is written now.
GRACE_S = 86_400.0


class Part(StrictRecord):
    """A part of a bundle.

    Parameters
    ----------
    kind : `rows/TABLE`, or `blobs` for a list of blobs, which are parts themselves
    digest : SHA-256 of its bytes, by which it is named
    bytes : its size
    rows : number of rows in it
    source : digest of its rows as they are in the store, which no other rows have
    """

    kind: str = Field(pattern=r"^(rows/[a-z_]{1,63}|blobs)$")
    digest: str = Field(pattern="^[0-9a-f]{64}$")
    bytes: int = Field(ge=0)
    rows: int = Field(ge=0)
    source: str = Field(pattern="^[0-9a-f]{64}$")


class BundleManifest(StrictRecord):
    """The content of a bundle.

    Parameters
    ----------
    created_at : when it was begun; its state is not older
    sceneprint, schema_revision : version and schema of the store that wrote it
    maps, signatures, blobs : how many there are
    frames : how many are in each state
    lost : blobs that were missing or damaged in the store
    blob_bytes : bytes of all blobs together
    numbers : the last row number that each table has given out
    parts : lists of blobs and rows, in the order of their keys
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
        """Its name, which sorts by time."""
        return f"{self.created_at:%Y%m%dT%H%M%S-%f}Z"

    @property
    def n_frames(self) -> int:
        """Frames that are not deleted."""
        return sum(n for state, n in self.frames.items() if state != "deleted")

    @property
    def bytes(self) -> int:
        """Bytes of all parts, each counted once for this bundle."""
        return self.blob_bytes + sum(one.bytes for one in self.parts)


class BundlePlace:
    """A folder or an object store with bundles; safe to share between threads.

    Every method raises UnusableStore where the place cannot be used.
    """

    def __init__(self, objects: Objects, folder: Path | None) -> None:
        self._objects, self._folder = objects, folder
        #: Where it is, for messages; without credentials.
        self.shown = str(folder) if folder is not None else objects.url
        self._sizes = cache(self._list)  # by the first two digits of the digest

    @classmethod
    def open(cls, place: str, *, create: bool = False) -> BundlePlace:
        """Open a place.

        Parameters
        ----------
        place : path of a folder, or URL of an object store; see `open_objects`
        create : make a folder that is missing

        Raises
        ------
        BundleError : there is no such folder.
        UnusableStore : the URL names no object store.
        """
        if "://" in place:
            return cls(open_objects(place, "the place of the bundles"), None)
        folder = Path(os.path.realpath(place))
        if not create and not folder.is_dir():
            raise BundleError(f"{place}: there is no such folder. Name the place of the bundles.")
        if folder.exists() and not folder.is_dir():
            raise BundleError(f"{place} is no folder. Name another place for the bundles.")
        if create:
            make_folder(folder)
        url = f"file://{quote(str(folder))}"
        return cls(open_objects(url, "the place of the bundles"), folder)

    def claim(self, owner: str) -> None:
        """Mark the place as one store's.

        Raises
        ------
        BundleError : it holds another store's bundles, or something else.
        """
        data = json.dumps({"format": "sceneprint-place", "store": owner}).encode()
        if self._objects.put(_MARK, data, create=True):
            ours = (_MARK, _BUNDLES, _PARTS, ".lock")
            others = (one.key for one in self._objects.list("") if not one.key.startswith(ours))
            other = next(others, None)
            if other is not None:
                self._objects.delete(_MARK)
                raise BundleError(
                    f"{self.shown} holds {other}, which is no part of a bundle. Name an empty "
                    "place."
                )
        elif self._objects.get(_MARK) != data:
            raise BundleError(
                f"{self.shown} holds the bundles of another store. Give each store a place of its "
                f"own; if that store is gone for good, remove {_MARK} there."
            )
        if self._folder is not None:
            for name in (_BUNDLES, _PARTS):  # private: frames are pictures of somebody's rooms
                make_folder(self._folder / name)

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Hold the right to write to a folder; an object store has no such right.

        Raises
        ------
        BundleError : another process writes there.
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

    # manifests

    def names(self) -> list[str]:
        """Return the names of all bundles, the newest first."""
        found = (_NAME.fullmatch(one.key) for one in self._objects.list(_BUNDLES))
        return sorted((one[1] for one in found if one), reverse=True)

    def read(self, name: str | None = None) -> BundleManifest:
        """Return the manifest of a bundle, by default the newest.

        Raises
        ------
        BundleError : there is none of that name, or it is of another version.
        DamagedBundle : its bytes are not those that were written.
        """
        names = self.names()
        if not names or name not in (None, *names):
            shown = "" if name is None else f" {name!r:.80}"
            then = f"The newest are: {', '.join(names[:3])}." if names else "Name another place."
            raise BundleError(f"{self.shown} holds no bundle{shown}. {then}")
        key = f"{_BUNDLES}{name or names[0]}.json"
        found = self._objects.head(key)
        data = b"" if found is None or found.size > LONGEST else self._objects.get(key)
        return _decode(data, f"{self.shown}/{key}")

    def publish(self, manifest: BundleManifest) -> None:
        """Write a manifest; all parts that it names must be there."""
        self._objects.put(f"{_BUNDLES}{manifest.name}.json", seal(manifest))

    # parts

    def size(self, digest: str) -> int | None:
        """Return the bytes of a part, None where it is missing; parts are listed once."""
        return self._sizes(digest[:2]).get(digest)

    def put(self, data: bytes) -> tuple[str, bool]:
        """Write a part if it is missing; return its digest, and whether it was written."""
        digest = hashlib.sha256(data).hexdigest()
        if self.size(digest) == len(data):
            return digest, False
        self._objects.put(_key(digest), data)
        return digest, True

    def put_file(self, digest: str, file: BinaryIO) -> None:
        """Write a large part from a file whose digest the caller has checked."""
        self._objects.put_file(_key(digest), file)

    def get(self, digest: str) -> bytes:
        """Return the bytes of a part; DamagedBundle where it is missing or damaged."""
        try:
            data = self._objects.get(_key(digest))
        except FileNotFoundError:
            raise self.damaged(digest, "is missing") from None
        if hashlib.sha256(data).hexdigest() != digest:
            raise self.damaged(digest, "is damaged")
        return data

    def chunks(self, digest: str) -> Iterator[bytes]:
        """Yield the bytes of a large part, unchecked; DamagedBundle where it is missing."""
        try:
            yield from self._objects.chunks(_key(digest))
        except FileNotFoundError:
            raise self.damaged(digest, "is missing") from None

    def condition(self, digest: str) -> Condition:
        """Read a part, and return whether it is as it was written."""
        hashed = hashlib.sha256()
        try:
            for chunk in self._objects.chunks(_key(digest)):
                hashed.update(chunk)
        except FileNotFoundError:
            return "missing"
        return "sound" if hashed.hexdigest() == digest else "damaged"

    def damaged(self, digest: str, what: str) -> DamagedBundle:
        """Return the error that names a part."""
        return DamagedBundle(
            f"{self.shown}: the part {_key(digest)} {what}. Restore another bundle, or remove this "
            "part and take a snapshot: it is written again if the store still has its content."
        )

    # old bundles

    def prune(self, needed: Collection[str], keep: int) -> int:
        """Remove all bundles but the newest, and the parts that only they named.

        Parameters
        ----------
        needed : digests of all parts of the bundles that stay
        keep : how many stay

        Returns
        -------
        removed : parts
        """
        self._objects.delete(*(f"{_BUNDLES}{name}.json" for name in self.names()[keep:]))
        before = time.time() - GRACE_S
        found = [
            one.key for one in self._objects.list(_PARTS)
            if one.changed_at < before and is_digest(name := one.key.rpartition("/")[2])
            and name not in needed
        ]  # fmt: skip
        self._objects.delete(*found)
        if self._folder is not None:  # what a writer that died left half written
            for path in self._folder.glob(f"{_PARTS}*/*#*"):
                if path.stat().st_mtime < before:
                    path.unlink(missing_ok=True)
        return len(found)

    def _list(self, first: str) -> dict[str, int]:
        folder = f"{_PARTS}{first}/"
        if self._folder is None:
            return {one.key.rpartition("/")[2]: one.size for one in self._objects.list(folder)}
        try:  # half the cost of the same through the store of objects
            with os.scandir(self._folder / folder) as found:
                return {one.name: one.stat().st_size for one in found}
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise UnusableStore(
                f"{self.shown}/{folder} cannot be listed ({error.strerror})."
            ) from error


def _key(digest: str) -> str:
    return f"{_PARTS}{digest[:2]}/{digest}"


def _decode(data: bytes, place: str) -> BundleManifest:
    try:
        record = unseal(data)
        if record.get("format") != "sceneprint-bundle":
            raise ValueError("it is of another format")
        if record.get("version") != 1:
            raise BundleError(
                f"{place}: a bundle of version {record.get('version')!r:.20}, and this sceneprint "
                "reads 1. Restore it with the sceneprint that wrote it."
            )
        return BundleManifest.model_validate_json(json.dumps(record))
    except (ValueError, RecursionError) as error:
        raise DamagedBundle(
            f"{place}: no manifest of a bundle, or damaged ({str(error).partition(chr(10))[0]}). "
            "Restore another bundle, or take another copy of this place."
        ) from error
