"""Where the indexes of all maps are: a folder of this machine, and a store that a fleet shares.

    builder  --share-->  PREFIX/index/MAP/  --sync-->  INDEXES/MAP/, which all other code reads

    MAP/SHA256.faiss        parts, see `sceneprint/index/part_files.py`
    MAP/0000000007.json     a manifest, written last; the store never replaces it
    index/.swept            when the store was last searched for indexes of maps that are gone

Without SCENEPRINT_INDEX_URL there is no store, and the folder is all there is. With it the folder
caches the store: a part that is there is neither put nor fetched. A manifest without bytes stands
for an index that was withdrawn: its number is not used again. What is fetched is verified as it is
written. Nobody needs the store to answer a query: whoever cannot reach it goes on with the folder.
"""

from __future__ import annotations

import hashlib
import logging
import math
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from sceneprint.atomic_files import PRIVATE_FILE, folder_turn
from sceneprint.engine.search.local_index import index_folder, is_index_folder, trusted
from sceneprint.errors import DamagedIndex, SceneprintError, UnusableStore
from sceneprint.index import IndexVersion, clear, manifests
from sceneprint.index.index_manifest import (
    IndexManifest,
    decode_manifest,
    manifest_number,
    read_manifest,
    write_manifest,
)
from sceneprint.index.index_version import keep_only, remove_unneeded
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
#: Seconds between two looks for a newer index of a map that is queried, and after an error.
LOOK_S = 30.0
#: Seconds after which what no manifest needs is removed: somebody may be fetching it.
GRACE_S = 600.0
#: Seconds after its last query for which the index of a map is not removed to make room.
IN_USE_S = 600.0


class IndexPlace:
    """The indexes of all maps; safe to share between threads.

    Methods that use the object store raise UnusableStore where it cannot be used.
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        self._database, self._indexes = store.database, settings.indexes
        self._most_bytes, self._tail_frames = settings.index_cache_bytes, settings.unindexed_frames
        self._purge_s, url = settings.purge_deadline_s, settings.index_url
        self._store = None if url is None else open_objects(str(url), "SCENEPRINT_INDEX_URL")
        self._claimed = False
        self._lock = threading.Lock()
        self._wanted: dict[str, MapRow] = {}
        self._looked: dict[str, float] = {}
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._stale: dict[str, frozenset[str]] = {}

    @property
    def is_shared(self) -> bool:
        """Whether a fleet shares the indexes."""
        return self._store is not None

    def close(self) -> None:
        """End fetching, within a block of a part."""
        self._stop.set()
        self.finish()

    def finish(self) -> None:
        """Wait until nothing is being fetched for queries."""
        thread = self._thread
        if thread is not None:
            thread.join()

    def folder(self, row: MapRow) -> Path:
        """Return the folder of the index of a map."""
        return index_folder(self._indexes, row)

    # the newest index, for whoever builds the next one

    def head(self, row: MapRow) -> IndexManifest | None:
        """Return the newest manifest of a map; None where there is none, or it was withdrawn."""
        if self._store is not None:
            numbered = _numbered(self._list(row))
            return self._read(numbered[-1]) if numbered else None
        for _, path in manifests(self.folder(row)):
            with suppress(DamagedIndex):
                return read_manifest(path)
        return None

    def last_number(self, row: MapRow) -> int:
        """Return the last number that the store has of an index of a map; 0 where none."""
        numbered = _numbered(self._list(row))
        return _number(numbered[-1]) or 0 if numbered else 0

    def stale_keys(self, row: MapRow, manifest: IndexManifest) -> frozenset[str]:
        """Return the names of the keys of segments that hold frames that are gone."""
        if manifest.revision < row.pruned_revision:  # no row says any more which frames are gone
            return frozenset(manifest.keys)
        with self._database.read() as connection:
            deleted = deleted_since(connection, row.number, manifest.revision)
        gone, stale = np.fromiter(deleted, np.int64, len(deleted)), set(manifest.worn_keys)
        for name in manifest.keys if deleted else ():
            data = self._part(row, name)
            # of damaged keys nobody knows whose they are
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

    # publication

    @contextmanager
    def turn(self, row: MapRow) -> Iterator[Callable[[], None] | None]:
        """Have the turn to build a map's index, of all hosts; see `index_turn`."""
        if self._store is None:  # of one host, whose builders have the lock of the folder
            yield lambda: None
            return
        with index_turn(self._database, row.number) as mine:
            yield mine

    def share(self, row: MapRow, manifest: IndexManifest) -> bool:
        """Put an index into the store, if there is one; False where another has its number."""
        if self._store is None:
            return True
        prefix = self._prefix(row)
        there = {one.key: one.size for one in self._list(row)}
        for name, size in manifest.files:
            if there.get(f"{prefix}{name}") != size:
                self._store.put_file(f"{prefix}{name}", self.folder(row) / name)
        key, data = f"{prefix}{manifest.name}", seal(manifest)
        # one that was put by a try whose answer was lost is ours
        return self._store.put(key, data, create=True) or self._store.get(key) == data

    def prune(self, row: MapRow, *, clean: bool = False) -> None:
        """Remove from the store what no manifest needs that somebody may be fetching; in its turn.

        Parameters
        ----------
        clean : all but the newest at once, and not after some time
        """
        listed = self._list(row)
        numbered = _numbered(listed)
        if self._store is None or not numbered:
            return
        now = max(one.changed_at for one in listed)  # by the clock of the store
        before = math.inf if clean else now - GRACE_S
        kept = [one for one, after in pairwise(numbered) if after.changed_at >= before]
        needed = set[str]()
        for one in (*kept, numbered[-1]):
            found = self._read(one)
            files = () if found is None else found.files
            needed |= {one.key, *(f"{self._prefix(row)}{name}" for name, _ in files)}
        self._delete(o.key for o in listed if o.key not in needed and o.changed_at < before)

    def withdraw(self, row: MapRow) -> None:
        """Remove the indexes of a map from the store; their numbers are not used again."""
        number = self.last_number(row)
        if self._store is not None and number:
            self._store.put(f"{self._prefix(row)}{number:010d}.json", b"")
            self.prune(row, clean=True)

    def remove_all_but(self, row: MapRow, head: IndexManifest | None) -> bool:
        """Leave one index of a map, or none; False where somebody else is building there."""
        with self.turn(row) as mine:
            if mine is None:
                return False
            if head is None:
                self.withdraw(row)
            else:
                self.prune(row, clean=True)
        folder = self.folder(row)
        if not manifests(folder):
            return True
        found = None if head is None else self.sync(row)
        number = None if found is None else found.number
        return [one for one, _ in manifests(folder)] == [number] or clear(folder, but=number)

    # indexes of maps that are gone

    def sweep(self, *, now: bool = False) -> None:
        """Remove from the store the indexes of maps that are gone, once in the fleet at a time.

        Parameters
        ----------
        now : also where somebody did it a moment ago
        """
        if self._store is None:
            return
        self._claim(self._store)
        last = self._store.head(_SWEPT)
        if not now and last is not None and time.time() - last.changed_at < 0.45 * self._purge_s:
            return
        self._store.put(_SWEPT, b"")
        keys = [one.key for one in self._store.list(_FOLDER)]
        kept = self._known()
        self._delete(
            key for key in keys
            if is_index_folder(name := key.split("/")[1]) and name not in kept
        )  # fmt: skip

    def remove_unknown(self) -> None:
        """Remove from the folder the indexes of maps that are gone, and of models they had."""
        there = self._folders()
        known = self._known() if there else {}
        for folder in there:
            if folder.name not in known:
                shutil.rmtree(folder, ignore_errors=True)
                log.info("index removed", extra={"folder": folder.name})

    def _known(self) -> dict[str, MapRow]:
        """Return the maps that there are by the folders of their indexes, coming models' too."""
        with self._database.read() as connection:
            rows = list_maps(connection)
        rows += [replace(r, model_id=r.next_model_id) for r in rows if r.next_model_id is not None]
        return {self.folder(row).name: row for row in rows}

    def _folders(self) -> list[Path]:
        return [one for one in self._indexes.glob("*") if is_index_folder(one.name)]

    # the folder as a cache of the store

    def want(self, row: MapRow, version: IndexVersion | None) -> None:
        """Look for a newer index of a map that is queried, in the background, if it is time.

        Parameters
        ----------
        row : of the map
        version : that is used here
        """
        folder = self.folder(row)
        since = 0 if version is None else version.revision
        with self._lock:
            if time.monotonic() - self._looked.get(folder.name, -LOOK_S) < LOOK_S:
                return
            self._looked[folder.name] = time.monotonic()
            _mark_used(folder)
            if row.revision - since <= self._tail_frames:
                return  # nobody has published a newer one
            self._wanted[folder.name] = row
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._fetch, daemon=True, name="index")
                self._thread.start()

    def _fetch(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                if not self._wanted:
                    self._thread = None
                    return
                _, row = self._wanted.popitem()
            try:
                self.sync(row, needed=False)
            except (OSError, SceneprintError, ValueError) as error:  # queries go on without it
                log.warning("index not fetched", extra={"map": row.name, "error": str(error)})

    def sync(self, row: MapRow, *, needed: bool = True) -> IndexManifest | None:
        """Fetch the newest index of a map into the folder, if it is not there.

        Parameters
        ----------
        needed : even where there is no room for it beside what is in use

        Returns
        -------
        the manifest of what is here now; None where there is none that the database stands by

        Raises
        ------
        DamagedIndex : If it is damaged in the store; it was withdrawn, and workers build it anew.
        """
        folder, found = self.folder(row), self.head(row)
        if self._store is None or found is None or found.model_id != row.model_id:
            return found if self._store is None else None
        with self._database.read() as connection:
            now = find_map(connection, row.name)
            if now.number != row.number or trusted(connection, now, found) is None:
                return None
        lacking = [one for one in found.files if not _is_here(folder, *one)]
        with suppress(DamagedIndex):
            if not lacking and read_manifest(folder / found.name) == found:
                return found
        if not self._make_room(sum(size for _, size in lacking), folder) and not needed:
            log.warning("no room for an index", extra={"map": row.name, "bytes": self._most_bytes})
            return None
        with folder_turn(folder) as mine:
            if not mine:
                return None  # somebody fetches or builds it
            try:
                # small ones first: they are merged soon, and then removed from the store
                for name, size in sorted(found.files, key=lambda each: each[1]):
                    if not _is_here(folder, name, size):
                        self._get(self._store, folder, name, size)
            except UnusableStore:
                remove_unneeded(folder)  # a part of an index is nobody's, and nobody would purge it
                raise
            except (DamagedIndex, FileNotFoundError) as error:
                remove_unneeded(folder)
                if self.last_number(row) == found.number and not self._stop.is_set():
                    self.withdraw(row)
                    raise DamagedIndex(
                        f"{self._store.url}: index {found.number} of map {row.name!r} is damaged "
                        "there, and was withdrawn. A worker builds it anew."
                    ) from error
                return None  # another has taken its place
            write_manifest(folder, found)
            keep_only(folder, {found.number})
        _mark_used(folder)
        return found

    def purge_local(self) -> None:
        """Remove from the folder indexes that have held deleted frames since the last call.

        For a node without workers: those publish an index without these frames meanwhile. Each half
        of the time after which nothing may be left.
        """
        if self._store is None:
            return
        self.remove_unknown()
        known = self._known()
        for folder in self._folders():
            if folder.name in known and manifests(folder):
                try:
                    self._purge_folder(known[folder.name], folder)
                except (OSError, SceneprintError) as error:
                    extra = {"map": known[folder.name].name, "error": str(error)}
                    log.warning("purge incomplete", extra=extra)

    def _purge_folder(self, row: MapRow, folder: Path) -> None:
        with suppress(UnusableStore, DamagedIndex):  # then without what is newer
            self.sync(row)
        number, path = manifests(folder)[0]
        # by the parts with keys: a segment that has lost more frames since has the same
        stale = self.stale_keys(row, read_manifest(path))
        if stale & self._stale.get(folder.name, frozenset()) or len(manifests(folder)) > 1:
            clear(folder, but=None if stale else number)
        self._stale[folder.name] = stale

    def _make_room(self, size: int, keep: Path) -> bool:
        """Remove indexes that were not used for long, the longest first; whether there is room."""
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
                    raise DamagedIndex(f"{name}: fetching was ended.")
                take(chunk)

        made, length = put(folder, name.rpartition(".")[2], write)
        if (made, length) != (name, size):
            (folder / made).unlink(missing_ok=True)
            raise DamagedIndex(f"{name}: its bytes are not those that were written.")

    # objects of the store

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
        """Remove objects, manifests first: they should not promise what is gone."""
        if self._store is not None:
            self._store.delete(*sorted(keys, key=lambda key: not key.endswith(".json")))

    def _claim(self, store: Objects) -> None:
        if not self._claimed:
            owner, anew = OpaqueIds(self._database).owner, not self._database.read_only
            self._claimed = BucketOwner(store).claim(owner, anew=anew)


def _number(listed: ListedObject) -> int | None:
    return manifest_number(listed.key.rpartition("/")[2])


def _numbered(listed: Iterable[ListedObject]) -> list[ListedObject]:
    """Return the manifests among objects, the newest last."""
    return sorted((one for one in listed if _number(one) is not None), key=lambda one: one.key)


def _is_here(folder: Path, name: str, size: int) -> bool:
    try:
        return (folder / name).stat().st_size == size
    except OSError:
        return False


def _mark_used(folder: Path) -> None:
    """Note that the index of a map is in use, if it is here."""
    with suppress(OSError):
        (folder / _USED).touch(PRIVATE_FILE)


def _used_at(folder: Path) -> float:
    try:
        return (folder / _USED).stat().st_mtime
    except OSError:
        return 0.0
