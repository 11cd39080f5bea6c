"""Storage of indexes: a local folder, and optionally an object store that a fleet shares.

    builder  --share-->  PREFIX/index/MAP/  --sync-->  INDEXES/MAP/, which all other code reads

    MAP/SHA256.faiss        parts, see `sceneprint/index/part_files.py`
    MAP/0000000007.json     a manifest, written last and never replaced
    index/.swept            date of the last removal of indexes of deleted maps

The object store is used if SCENEPRINT_INDEX_URL is set. The folder then caches it; downloaded parts
are verified. An empty manifest marks a withdrawn index; its number is not reused. Queries use only
the folder, so they do not depend on the object store.
"""

from __future__ import annotations

import hashlib
import logging
import math
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from sceneprint.atomic_files import PRIVATE_FILE, folder_turn
from sceneprint.engine.search.local_index import index_folder, is_index_folder, trusted
from sceneprint.errors import DamagedIndex, SceneprintError, UnusableStore
from sceneprint.index.index_manifest import (
    IndexManifest,
    decode_manifest,
    manifest_number,
    manifests,
    read_manifest,
    write_manifest,
)
from sceneprint.index.index_version import IndexVersion, clear, keep_only, remove_unneeded
from sceneprint.index.part_files import put
from sceneprint.sealed_record import seal
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.blobs.object_client import ListedObject, Objects, open_objects
from sceneprint.store.blobs.object_store import BucketOwner
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.opaque_ids import OpaqueIds
from sceneprint.store.postgres.session_locks import index_turn
from sceneprint.store.signatures import deleted_since
from sceneprint.store.tables import MapRow

log = logging.getLogger(__name__)

_FOLDER, _SWEPT, _USED = "index/", "index/.swept", ".used"
#: Seconds between checks for a newer index of a queried map.
LOOK_S = 30.0
#: Minimum age, in seconds, at which unlisted parts are removed; other hosts may still be
#: downloading younger parts.
GRACE_S = 600.0
#: Seconds after the last query of a map during which its index is not evicted.
IN_USE_S = 600.0


class IndexPlace:
    """Indexes of all maps; safe to share between threads.

    Methods that use the object store raise UnusableStore if it is not accessible.
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        self._database, self._indexes = store.database, settings.indexes
        self._most_bytes, self._tail_frames = settings.index_cache_bytes, settings.unindexed_frames
        self._purge_s, url = settings.purge_deadline_s, settings.index_url
        self._store = None if url is None else open_objects(str(url), "SCENEPRINT_INDEX_URL")
        self._claimed = False
        self._lock = threading.Lock()
        self._looked: dict[str, float] = {}
        self._fetches = ThreadPoolExecutor(1, "index")
        self._stop = threading.Event()
        self._stale: dict[str, frozenset[str]] = {}

    @property
    def is_shared(self) -> bool:
        """Return whether the indexes are shared through an object store."""
        return self._store is not None

    def close(self) -> None:
        """Stop downloads after the current block."""
        self._stop.set()
        self._fetches.shutdown(cancel_futures=True)

    def folder(self, row: MapRow) -> Path:
        """Return the local folder of the index of a map."""
        return index_folder(self._indexes, row)

    def head(self, row: MapRow) -> IndexManifest | None:
        """Return the newest manifest of a map; None if there is no index, or if the newest is
        withdrawn.
        """
        if self._store is not None:
            numbered = _numbered(self._list(row))
            return self._read(numbered[-1]) if numbered else None
        for _, path in manifests(self.folder(row)):
            with suppress(DamagedIndex):
                return read_manifest(path)
        return None

    def last_number(self, row: MapRow) -> int:
        """Return the highest index number of a map in the object store; 0 if there is no index."""
        numbered = _numbered(self._list(row))
        return _number(numbered[-1]) or 0 if numbered else 0

    def stale_keys(self, row: MapRow, manifest: IndexManifest) -> frozenset[str]:
        """Return the names of the key files of segments that contain deleted frames."""
        if manifest.revision < row.pruned_revision:  # the rows of deleted frames no longer exist
            return frozenset(manifest.keys)
        with self._database.read() as connection:
            deleted = deleted_since(connection, row.number, manifest.revision)
        gone, stale = np.fromiter(deleted, np.int64, len(deleted)), set(manifest.worn_keys)
        for name in manifest.keys if deleted else ():
            data = self._part(row, name)
            # count damaged files too, since they may contain deleted frames
            is_sound = hashlib.sha256(data).hexdigest() == name.partition(".")[0]
            if not is_sound or np.isin(np.frombuffer(data, "<i8"), gone).any():
                stale.add(name)
        return frozenset(stale)

    def _part(self, row: MapRow, name: str) -> bytes:
        with suppress(OSError):
            return (self.folder(row) / name).read_bytes()
        with suppress(FileNotFoundError):
            if self._store is not None:
                return self._store.get(f"{self._prefix(row)}{name}")
        return b""

    @contextmanager
    def turn(self, row: MapRow) -> Iterator[Callable[[], None] | None]:
        """Lock the index of a map against builders on other hosts; yield None if one holds the
        lock.

        Otherwise, yield a function that checks that the lock is still held; see `index_turn`.
        """
        if self._store is None:  # builders on the same host lock the folder
            yield lambda: None
            return
        with index_turn(self._database, row.number) as mine:
            yield mine

    def share(self, row: MapRow, manifest: IndexManifest) -> bool:
        """Upload an index to the object store, if any; return False if its number is in use."""
        if self._store is None:
            return True
        prefix = self._prefix(row)
        sizes = {entry.key: entry.size for entry in self._list(row)}
        for name, size in manifest.files:
            if sizes.get(f"{prefix}{name}") != size:
                self._store.put_file(f"{prefix}{name}", self.folder(row) / name)
        key, data = f"{prefix}{manifest.name}", seal(manifest)
        # an earlier attempt without a response may have stored the same manifest
        return self._store.put(key, data, create=True) or self._store.get(key) == data

    def prune(self, row: MapRow, *, clean: bool = False) -> None:
        """Remove old manifests and unlisted parts from the object store; the caller holds the lock.

        Parameters
        ----------
        clean : whether to remove old versions at once, instead of after GRACE_S
        """
        listed = self._list(row)
        numbered = _numbered(listed)
        if self._store is None or not numbered:
            return
        now = max(entry.changed_at for entry in listed)  # use the clock of the object store
        before = math.inf if clean else now - GRACE_S
        fetchable = [entry for entry, after in pairwise(numbered) if after.changed_at >= before]
        needed = set[str]()
        for entry in (*fetchable, numbered[-1]):
            manifest = self._read(entry)
            files = () if manifest is None else manifest.files
            needed |= {entry.key, *(f"{self._prefix(row)}{name}" for name, _ in files)}
        self._delete(o.key for o in listed if o.key not in needed and o.changed_at < before)

    def withdraw(self, row: MapRow) -> None:
        """Remove the index of a map from the object store; its number is not reused."""
        number = self.last_number(row)
        if self._store is not None and number:
            self._store.put(f"{self._prefix(row)}{number:010d}.json", b"")
            self.prune(row, clean=True)

    def remove_all_but(self, row: MapRow, head: IndexManifest | None) -> bool:
        """Remove all versions of the index of a map except `head`.

        Return False without removal if another process is building the index.
        """
        with self.turn(row) as mine:
            if mine is None:
                return False
            if head is None:
                self.withdraw(row)
            else:
                self.prune(row, clean=True)
        folder = self.folder(row)
        if not folder.is_dir():
            return True
        manifest = None if head is None or not manifests(folder) else self.sync(row)
        # clear it even without other versions: a failed or killed removal may have left parts
        return clear(folder, keep=None if manifest is None else manifest.number)

    def sweep(self, *, now: bool = False) -> None:
        """Remove indexes of deleted maps from the object store, at intervals, on one host at a
        time.

        Parameters
        ----------
        now : whether to ignore the interval
        """
        if self._store is None:
            return
        self._claim(self._store)
        last = self._store.head(_SWEPT)
        if not now and last is not None and time.time() - last.changed_at < 0.45 * self._purge_s:
            return
        self._store.put(_SWEPT, b"")
        keys = [entry.key for entry in self._store.list(_FOLDER)]
        rows_by_folder = self._known()
        self._delete(
            key for key in keys
            if is_index_folder(name := key.split("/")[1]) and name not in rows_by_folder
        )  # fmt: skip

    def remove_unknown(self) -> None:
        """Remove local indexes of deleted maps and of former models."""
        folders = self._folders()
        rows_by_folder = self._known() if folders else {}
        for folder in folders:
            if folder.name not in rows_by_folder:
                shutil.rmtree(folder, ignore_errors=True)
                log.info("index removed", extra={"folder": folder.name})

    def _known(self) -> dict[str, MapRow]:
        """Return all maps by the names of their index folders, including folders of next models."""
        with self._database.read() as connection:
            rows = list_maps(connection)
        rows += [replace(r, model_id=r.next_model_id) for r in rows if r.next_model_id is not None]
        return {self.folder(row).name: row for row in rows}

    def _folders(self) -> list[Path]:
        return [folder for folder in self._indexes.glob("*") if is_index_folder(folder.name)]

    def want(self, row: MapRow, version: IndexVersion | None) -> None:
        """Check for a newer index of a queried map, at intervals, and download it in the
        background.

        Parameters
        ----------
        version : current local version; None if there is no index
        """
        folder = self.folder(row)
        since = 0 if version is None else version.revision
        with self._lock:
            if time.monotonic() - self._looked.get(folder.name, -LOOK_S) < LOOK_S:
                return
            self._looked[folder.name] = time.monotonic()
        _mark_used(folder)
        if row.revision - since > self._tail_frames:
            with suppress(RuntimeError):  # after `close`
                self._fetches.submit(self._fetch, row)

    def _fetch(self, row: MapRow) -> None:
        try:
            self.sync(row, needed=False)
        except (OSError, SceneprintError, ValueError) as error:
            log.warning("index not fetched", extra={"map": row.name, "error": str(error)})

    def sync(self, row: MapRow, *, needed: bool = True) -> IndexManifest | None:
        """Download the newest index of a map to its local folder, unless it is there.

        Parameters
        ----------
        needed : whether to download the index even if the cache is full

        Returns
        -------
        manifest : manifest of the local version; None if no version that is consistent with the
            database is available, or another process is writing to the folder

        Raises
        ------
        DamagedIndex : If the shared index is damaged. It is withdrawn, and workers rebuild it.
        """
        folder, manifest = self.folder(row), self.head(row)
        if self._store is None or manifest is None or manifest.model_id != row.model_id:
            return manifest if self._store is None else None
        with self._database.read() as connection:
            now = find_map(connection, row.name)
            if now.number != row.number or trusted(connection, now, manifest) is None:
                return None
        missing = [file for file in manifest.files if not _is_here(folder, *file)]
        with suppress(DamagedIndex):
            if not missing and read_manifest(folder / manifest.name) == manifest:
                return manifest
        if not self._make_room(sum(size for _, size in missing), folder) and not needed:
            log.warning("no room for an index", extra={"map": row.name, "bytes": self._most_bytes})
            return None
        with folder_turn(folder) as mine:
            if not mine:
                return None  # another process is downloading or building the index
            try:
                # download small parts first, since merges soon remove them from the object store
                for name, size in sorted(manifest.files, key=lambda each: each[1]):
                    if not _is_here(folder, name, size):
                        self._get(self._store, folder, name, size)
            except UnusableStore:
                remove_unneeded(folder)
                raise
            except (DamagedIndex, FileNotFoundError) as error:
                remove_unneeded(folder)
                if self.last_number(row) == manifest.number and not self._stop.is_set():
                    self.withdraw(row)
                    raise DamagedIndex(
                        f"{self._store.url}: index {manifest.number} of map {row.name!r} is "
                        "damaged and was withdrawn. A worker will rebuild it."
                    ) from error
                return None  # replaced by a newer version
            write_manifest(folder, manifest)
            keep_only(folder, {manifest.number})
        _mark_used(folder)
        return manifest

    def purge_local(self) -> None:
        """Remove local indexes that still contain the same deleted frames as at the last call.

        Call this on nodes without workers, at intervals of half the purge deadline. Between two
        calls, workers publish an index without these frames.
        """
        if self._store is None:
            return
        self.remove_unknown()
        rows = self._known()
        for folder in self._folders():
            if folder.name in rows:
                try:
                    self._purge_folder(rows[folder.name], folder)
                except (OSError, SceneprintError) as error:
                    extra = {"map": rows[folder.name].name, "error": str(error)}
                    log.warning("purge incomplete", extra=extra)

    def _purge_folder(self, row: MapRow, folder: Path) -> None:
        if not manifests(folder):
            clear(folder)
            return
        with suppress(UnusableStore, DamagedIndex):
            self.sync(row)
        number, path = manifests(folder)[0]
        # compare names of key files, which do not change when further frames are deleted
        stale = self.stale_keys(row, read_manifest(path))
        stale_before = self._stale.get(folder.name, frozenset())
        is_outdated = bool(stale and (stale & stale_before or len(manifests(folder)) > 1))
        # this also removes parts that no version lists
        clear(folder, keep=None if is_outdated else number)
        self._stale[folder.name] = stale

    def _make_room(self, size: int, keep: Path) -> bool:
        """Evict the least recently used indexes, except `keep`, to make room for `size` bytes.

        Return whether there is enough room.
        """
        sizes = {o: sum(file.stat().st_size for file in o.glob("*.*")) for o in self._folders()}
        total = size + sum(sizes.values())
        for folder in sorted(sizes, key=_used_at):
            if total <= self._most_bytes:
                break
            if folder != keep and _used_at(folder) < time.time() - IN_USE_S and clear(folder):
                total -= sizes[folder]
                log.info("index removed to make room", extra={"folder": folder.name})
        return total <= self._most_bytes

    def _get(self, store: Objects, folder: Path, name: str, size: int) -> None:
        def write(take: Callable[[bytes], None]) -> None:
            for chunk in store.chunks(f"{_FOLDER}{folder.name}/{name}"):
                if self._stop.is_set():
                    raise DamagedIndex(f"{name}: fetching was stopped.")
                take(chunk)

        written, length = put(folder, name.rpartition(".")[2], write)
        if (written, length) != (name, size):
            (folder / written).unlink(missing_ok=True)
            raise DamagedIndex(f"{name}: the bytes are damaged.")

    def _prefix(self, row: MapRow) -> str:
        return f"{_FOLDER}{self.folder(row).name}/"

    def _list(self, row: MapRow) -> list[ListedObject]:
        if self._store is None:
            return []
        self._claim(self._store)
        return list(self._store.list(self._prefix(row)))

    def _read(self, listed: ListedObject) -> IndexManifest | None:
        if self._store is None or listed.size == 0:
            return None
        try:
            data = self._store.get(listed.key)
            return decode_manifest(listed.key.rpartition("/")[2], data, listed.key)
        except (DamagedIndex, FileNotFoundError) as error:
            log.warning("shared index skipped: %s", error)
            return None

    def _delete(self, keys: Iterable[str]) -> None:
        """Remove objects, manifests first, so that no manifest lists a missing part."""
        if self._store is not None:
            self._store.delete(*sorted(keys, key=lambda key: not key.endswith(".json")))

    def _claim(self, store: Objects) -> None:
        if not self._claimed:
            owner, anew = OpaqueIds(self._database).owner, not self._database.read_only
            self._claimed = BucketOwner(store).claim(owner, anew=anew)


def _number(listed: ListedObject) -> int | None:
    return manifest_number(listed.key.rpartition("/")[2])


def _numbered(listed: Iterable[ListedObject]) -> list[ListedObject]:
    """Return the manifests among objects, newest last."""
    numbered = (entry for entry in listed if _number(entry) is not None)
    return sorted(numbered, key=lambda entry: entry.key)


def _is_here(folder: Path, name: str, size: int) -> bool:
    try:
        return (folder / name).stat().st_size == size
    except OSError:
        return False


def _mark_used(folder: Path) -> None:
    """Set the last use of a local index to now, if the index exists."""
    with suppress(OSError):
        (folder / _USED).touch(PRIVATE_FILE)


def _used_at(folder: Path) -> float:
    try:
        return (folder / _USED).stat().st_mtime
    except OSError:
        return 0.0
