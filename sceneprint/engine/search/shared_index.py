"""Generations that a fleet shares: built once, kept in an object store, fetched where needed.

    PREFIX/index/MAP/SHA256.faiss       files, under the names that they have in a folder
    PREFIX/index/MAP/0000000007.json    the manifest of generation 7, put last, and never replaced
    PREFIX/index/.swept                 when folders of maps that are gone were last looked for

builder  --share-->  object store  --sync-->  the folder that all other code reads

Most files of a generation are those of the one before: what is there is neither put nor fetched.
A manifest without bytes stands for a generation that was withdrawn: its number is not used again.
What is fetched is verified as it is written, data first and the manifest last. Nobody needs the
store to answer a query: whoever cannot reach it goes on with what is here.
"""

from __future__ import annotations

import logging
import re
import shutil
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from sceneprint.atomic_files import PRIVATE_FILE, folder_turn
from sceneprint.engine.search.local_index import index_folder, is_index_folder, trusted
from sceneprint.errors import DamagedIndex, SceneprintError, UnusableStore
from sceneprint.index import Generation, clear, manifests
from sceneprint.index.generation import remove_all_but, remove_unneeded
from sceneprint.index.generation_files import (
    GenerationManifest,
    Keys,
    decode_manifest,
    encode_manifest,
    is_file_name,
    manifest_name,
    mapped,
    put,
    read_manifest,
)
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.blobs.object_client import Objects, open_objects
from sceneprint.store.blobs.object_store import BucketOwner
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.opaque_ids import OpaqueIds
from sceneprint.store.postgres.session_locks import index_turn
from sceneprint.store.signatures import deleted_since
from sceneprint.store.tables import MapRow

log = logging.getLogger(__name__)

_FOLDER, _SWEPT, _USED = "index/", "index/.swept", ".used"
_NUMBER = re.compile(r"(\d{10})\.json")
#: Seconds between two looks for a newer generation of a map that is asked, and after an error.
LOOK_S = 30.0
#: Seconds after which what no generation needs is removed: somebody may be fetching it.
GRACE_S = 600.0
#: Seconds after its last query for which the index of a map is not removed to make room.
IN_USE_S = 600.0


class SharedIndexes:
    """The shared generations of all maps, and what of them is here; safe to share between threads.

    Parameters
    ----------
    store : whose maps they are of
    settings : see Settings; `index_url` is set

    Methods that ask the object store raise UnusableStore where it cannot be used.
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        self._database, self._indexes = store.database, settings.indexes
        self._most_bytes, self._tail_frames = settings.index_bytes, settings.tail_frames
        self._purge_s = settings.purge_s
        self._objects: Objects = open_objects(str(settings.index_url), "SCENEPRINT_INDEX_URL")
        self._claimed = False
        self._lock = threading.Lock()
        self._wanted: dict[str, MapRow] = {}
        self._looked: dict[str, float] = {}
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._stale: dict[str, frozenset[str]] = {}

    def close(self) -> None:
        """End fetching, within a part of a file."""
        self._stop.set()
        self.finish()

    def finish(self) -> None:
        """Wait until nothing is being fetched for queries."""
        thread = self._thread
        if thread is not None:
            thread.join()

    # the store

    def head(self, row: MapRow) -> GenerationManifest | None:
        """The newest generation of a map; None where there is none, or it was withdrawn."""
        listed = self._listed(index_folder(self._indexes, row).name)
        return None if listed is None else self._read(*listed)

    def newest_number(self, row: MapRow) -> int:
        """The last number that was given to a generation of a map; 0 where none was."""
        listed = self._listed(index_folder(self._indexes, row).name)
        return 0 if listed is None else listed[1]

    def keys(self, row: MapRow, manifest: GenerationManifest) -> Keys:
        """Keys of the frames in the files of a generation; none of a file that is gone."""
        folder, found = index_folder(self._indexes, row).name, [np.empty(0, np.int64)]
        for name in manifest.keys:
            with suppress(FileNotFoundError):
                found.append(np.frombuffer(self._objects.get(f"{_FOLDER}{folder}/{name}"), "<i8"))
        return np.concatenate(found)

    @contextmanager
    def turn(self, row: MapRow) -> Iterator[Callable[[], None] | None]:
        """The right to build a map's index, of all hosts; see `index_turn`."""
        with index_turn(self._database, row.number) as mine:
            yield mine

    def share(self, folder: Path, manifest: GenerationManifest) -> bool:
        """Put a generation into the store, its files first.

        Parameters
        ----------
        folder : where its files are
        manifest : of a number that is larger than any there

        Returns
        -------
        done : False where another has that number
        """
        self._claim()
        there = {one.key: one.size for one in self._objects.list(f"{_FOLDER}{folder.name}/")}
        for name, size in manifest.files:
            key = f"{_FOLDER}{folder.name}/{name}"
            if there.get(key) != size:
                self._objects.put_file(key, folder / name)
        data = encode_manifest(manifest)
        key = f"{_FOLDER}{folder.name}/{manifest.number:010d}.json"
        # one that was put by a try whose answer was lost is ours
        return self._objects.put(key, data, create=True) or self._objects.get(key) == data

    def tidy(self, row: MapRow, *, clean: bool = False) -> None:
        """Remove what no generation needs that somebody may be fetching; in its turn alone.

        Parameters
        ----------
        clean : all but the newest at once, and not after some time
        """
        name = index_folder(self._indexes, row).name
        listed = sorted(self._objects.list(f"{_FOLDER}{name}/"), key=lambda one: one.key)
        numbered = [one for one in listed if _NUMBER.fullmatch(one.key.rpartition("/")[2])]
        if not numbered:
            return
        now = max(one.changed_at for one in listed)  # by the clock of the store
        kept = [
            one for one, after in pairwise(numbered)  # replaced a moment ago
            if not clean and after.changed_at >= now - GRACE_S
        ]  # fmt: skip
        needed = set[str]()
        for one in (*kept, numbered[-1]):
            found = self._read(name, int(one.key[-15:-5]), one.size)
            needed |= {one.key.rpartition("/")[2]}
            needed |= set() if found is None else {each for each, _ in found.files}
        old = [
            one.key for one in sorted(listed, key=lambda one: one not in numbered)
            if one.key.rpartition("/")[2] not in needed
            and (clean or one.changed_at < now - GRACE_S)
        ]  # fmt: skip
        for start in range(0, len(old), 500):
            self._objects.delete(*old[start : start + 500])

    def withdraw(self, row: MapRow) -> None:
        """Remove the generations of a map; their numbers are not used again."""
        name = index_folder(self._indexes, row).name
        number = self.newest_number(row)
        if number:
            self._objects.put(f"{_FOLDER}{name}/{number:010d}.json", b"")
            self.tidy(row, clean=True)

    def sweep(self, known: Callable[[], Collection[str]], *, now: bool = False) -> None:
        """Remove the generations of maps that are gone, once in the fleet at a time.

        Parameters
        ----------
        known : names of the folders of maps that there are; asked after the store is
        now : also where somebody did it a moment ago
        """
        self._claim()
        last = self._objects.look(_SWEPT)
        if not now and last is not None and time.time() - last.changed_at < 0.45 * self._purge_s:
            return
        self._objects.put(_SWEPT, b"")
        found: dict[str, list[str]] = {}
        for one in self._objects.list(_FOLDER):
            name, _, file = one.key.removeprefix(_FOLDER).partition("/")
            if file and is_index_folder(name):
                found.setdefault(name, []).append(one.key)
        kept = set(known())
        for name in found.keys() - kept:
            gone = sorted(found[name], key=lambda key: not key.endswith(".json"))
            for start in range(0, len(gone), 500):
                self._objects.delete(*gone[start : start + 500])

    # what is here

    def want(self, row: MapRow, generation: Generation | None) -> None:
        """Look for a newer generation of a map that is asked, in the background, if it is time.

        Parameters
        ----------
        row : of the map
        generation : that is used here
        """
        folder = index_folder(self._indexes, row)
        since = 0 if generation is None else generation.revision
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

    def sync(self, row: MapRow, *, needed: bool = True) -> GenerationManifest | None:
        """Have the newest shared generation of a map here.

        Parameters
        ----------
        needed : even where there is no room for it beside what is in use

        Returns
        -------
        what is here now of the store; None where the store has none that the database stands by

        Raises
        ------
        DamagedIndex : it is damaged in the store; it was withdrawn, and workers make it anew.
        """
        folder, found = index_folder(self._indexes, row), self.head(row)
        if found is None or found.model_id != row.model_id:
            return None
        with self._database.read() as connection:
            now = find_map(connection, row.name)
            if now.number != row.number or trusted(connection, now, found) is None:
                return None
        lacking = [one for one in found.files if not _is_here(folder, *one)]
        if not lacking and (folder / manifest_name(found)).exists():
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
                        self._get(folder, name, size)
            except UnusableStore:
                remove_unneeded(folder)  # a part of an index is nobody's, and nobody would purge it
                raise
            except (DamagedIndex, FileNotFoundError) as error:
                remove_unneeded(folder)
                if self.newest_number(row) == found.number and not self._stop.is_set():
                    self.withdraw(row)
                    raise DamagedIndex(
                        f"{self._objects.url}: generation {found.number} of map {row.name!r} is "
                        "damaged there, and was withdrawn. A worker builds it anew."
                    ) from error
                return None  # another has taken its place
            remove_all_but(folder, found)
        _mark_used(folder)
        return found

    def purge_local(self) -> None:
        """Let no generation stay here that has held deleted frames since the last time, and none of
        maps that are gone.

        For a node without workers: those publish one without these frames meanwhile. Each half of
        the time after which nothing may be left.
        """
        folders = [one for one in self._indexes.glob("*") if is_index_folder(one.name)]
        with self._database.read() as connection:
            rows = list_maps(connection)
        coming = [replace(r, model_id=r.next_model_id) for r in rows if r.next_model_id is not None]
        known = {index_folder(self._indexes, row): row for row in (*rows, *coming)}
        for folder in folders:
            if folder not in known:
                shutil.rmtree(folder, ignore_errors=True)
            elif manifests(folder):
                try:
                    self._purge_folder(known[folder], folder)
                except (OSError, SceneprintError) as error:
                    extra = {"map": known[folder].name, "error": str(error)}
                    log.warning("purge incomplete", extra=extra)

    def _purge_folder(self, row: MapRow, folder: Path) -> None:
        with suppress(UnusableStore, DamagedIndex):  # then without what is newer
            self.sync(row)
        number, path = manifests(folder)[0]
        found = read_manifest(path)
        with self._database.read() as connection:
            gone = np.fromiter(deleted_since(connection, row.number, found.revision), np.int64)
        # of what one that old has too much, no row tells any more
        pruned = found.revision < row.pruned_revision
        # by the files of their keys: a segment of which more is gone since is the same
        stale = frozenset(
            name for name in found.keys
            if pruned or name in found.worn_keys
            or np.isin(np.frombuffer(mapped(folder / name), "<i8"), gone).any()
        )  # fmt: skip
        if stale & self._stale.get(folder.name, frozenset()) or len(manifests(folder)) > 1:
            clear(folder, but=None if stale else number)
        self._stale[folder.name] = stale

    def _make_room(self, size: int, keep: Path) -> bool:
        """Remove indexes that were not used for long, the longest first; whether there is room."""
        found = [one for one in self._indexes.glob("*") if is_index_folder(one.name)]
        sizes = {one: sum(file.stat().st_size for file in one.glob("*.*")) for one in found}
        total = size + sum(sizes.values())
        for folder in sorted(found, key=_used_at):
            if total <= self._most_bytes:
                break
            if folder != keep and _used_at(folder) < time.time() - IN_USE_S and clear(folder):
                total -= sizes[folder]
                log.info("index removed to make room", extra={"folder": folder.name})
        return total <= self._most_bytes

    def _get(self, folder: Path, name: str, size: int) -> None:
        def write(take: Callable[[bytes], None]) -> None:
            for chunk in self._objects.chunks(f"{_FOLDER}{folder.name}/{name}"):
                if self._stop.is_set():
                    raise DamagedIndex(f"{name}: fetching was ended.")
                take(chunk)

        made, length = put(folder, name.rpartition(".")[2], write)
        if (made, length) != (name, size):
            (folder / made).unlink(missing_ok=True)
            raise DamagedIndex(f"{name}: its bytes are not those that were written.")

    def _listed(self, name: str) -> tuple[str, int, int] | None:
        """The folder, number and bytes of its newest manifest."""
        self._claim()
        numbers = []
        for one in self._objects.list(f"{_FOLDER}{name}/"):
            found = _NUMBER.fullmatch(one.key.rpartition("/")[2])
            if found:
                numbers.append((int(found[1]), one.size))
        return (name, *max(numbers)) if numbers else None

    def _read(self, name: str, number: int, size: int) -> GenerationManifest | None:
        if size == 0:
            return None
        try:
            key = f"{_FOLDER}{name}/{number:010d}.json"
            found = decode_manifest(Path(key), self._objects.get(key))
        except (DamagedIndex, FileNotFoundError) as error:
            log.warning("shared index skipped: %s", error)
            return None
        safe = all(is_file_name(each) for each, _ in found.files)
        return found if safe and found.number == number else None

    def _claim(self) -> None:
        if not self._claimed:
            owner = BucketOwner(self._objects)
            self._claimed = owner.claim(
                OpaqueIds(self._database).owner, anew=not self._database.read_only
            )


def open_shared(store: Store, settings: Settings) -> SharedIndexes | None:
    """The shared indexes, where the settings name a place for them."""
    return None if settings.index_url is None else SharedIndexes(store, settings)


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
