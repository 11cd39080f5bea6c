"""Publication and verification of indexes, for maps with many new or deleted frames."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.atomic_files import PRIVATE_FILE, make_folder
from sceneprint.engine.context import Context
from sceneprint.engine.search.local_index import trusted
from sceneprint.engine.upkeep.repair import resign_frames
from sceneprint.errors import (
    BusyIndex,
    DamagedIndex,
    InvalidRequest,
    SceneprintError,
    UnknownMap,
    UnusableStore,
)
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.index.index_manifest import IndexManifest, newest_number, scrub
from sceneprint.index.index_version import IndexVersion, newest, publish
from sceneprint.models import Model
from sceneprint.store.deletion import DAY_S, newest_deletion
from sceneprint.store.events import anchor_of_now
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.postgres.connection import allow
from sceneprint.store.queue import read_clock
from sceneprint.store.reencoding_rows import is_complete
from sceneprint.store.signatures import changes_since, count_gone, count_indexed, deleted_since
from sceneprint.store.tables import MapRow
from sceneprint.types import Bytes

log = logging.getLogger(__name__)

#: Seconds for which a step verifies indexes, while jobs wait.
STEP_S = 0.25
#: Name of the file whose modification time is the start time of the last verification round.
_STAMP = ".scrubbed"
#: Maximum seconds between checks for old deletions that an index does not contain.
AGING_S = 3600.0
#: Seconds until the next attempt, after a shared index could not be published or another host was
#: building it.
ELSEWHERE_S = 30.0
#: Name of a file in an index folder: its access time is the time of the last purge, and its
#: modification time that of the next purge.
_PURGED = ".rest"


class Scrubber:
    """Verification of all indexes of the machine in rounds; one worker runs each round.

    Parameters
    ----------
    pause_s : seconds between the starts of two rounds
    """

    def __init__(self, indexes: Path, pause_s: float) -> None:
        self._stamp, self._pause_s = indexes / _STAMP, pause_s
        self._round: Iterator[Path | None] | None = None

    def step(self, folders: Sequence[Path]) -> Path | None:
        """Verify indexes for STEP_S seconds, if a round is running or due.

        Returns
        -------
        folder : index folder from which a damaged file was removed, so that the index must be
            rebuilt; None if no damage was found
        """
        if self._round is None and self._start_round():
            self._round = chain.from_iterable(map(scrub, folders))
        until = time.monotonic() + STEP_S
        while self._round is not None and time.monotonic() < until:
            try:
                damaged = next(self._round)
            except StopIteration:
                self._round = None
                return None
            if damaged is not None:
                log.error("damaged index file removed", extra={"path": str(damaged)})
                damaged.unlink(missing_ok=True)  # readers skip versions with missing files
                return damaged.parent
        return None

    def _start_round(self) -> bool:
        """Return whether a round is due; if so, record its start for all processes."""
        with suppress(OSError):
            if time.time() - self._stamp.stat().st_mtime < self._pause_s:
                return False
        with suppress(OSError):
            make_folder(self._stamp.parent)
            self._stamp.touch(PRIVATE_FILE)
            return True
        return False


class Upkeep:
    """Publication and verification of the indexes of a machine."""

    def __init__(self, context: Context) -> None:
        settings = context.settings
        self._store, self._signers, self._place = context.store, context.signers, context.indexes
        self._tail_frames = settings.unindexed_frames
        self._elsewhere: dict[int, float] = {}  # time of the next attempt, by map
        # number and revision of the published index, by map and model
        self._published: dict[tuple[int, str], tuple[int, int]] = {}
        self._metrics: dict[str, Metric | None] = {}
        self._scrubber = Scrubber(settings.indexes, settings.index_check_interval_s)
        self._rows_s = DAY_S * settings.deleted_rows_days
        # time of the next check for old deletions, by map and model
        self._aged = dict[tuple[int, str], float]()

    def run(self) -> int:
        """Publish outdated indexes, remove unknown ones, and run a step of verification.

        Return the number of published indexes. Errors in single indexes are logged; queries read
        the unindexed frames from the database.
        """
        with self._store.database.read() as connection:
            rows = list_maps(connection)
        rows = [row for row in rows if self._metric(row.model_id) == "l2"]
        with self._store.database.read() as connection:
            due = [row for row in rows if self._is_due(connection, row)]
        # skip maps that another host has just handled
        now, due_at = time.monotonic(), self._elsewhere
        published = sum(self._try_publish(row) for row in due if now >= due_at.get(row.number, 0.0))
        self._place.remove_unknown()
        damaged = self._scrubber.step([self._place.folder(row) for row in rows])
        for row in rows:
            if self._place.folder(row) == damaged:
                published += self._try_publish(row, force=True)
        return published

    def rebuild(self, row: MapRow) -> IndexVersion:
        """Build the index of a map from scratch, publish it, and return it.

        Raises
        ------
        UnknownMap : If the map no longer exists.
        InvalidRequest : If the map has no indexed frames, or its metric has no index.
        BusyIndex : If another process is building the index.
        OSError : If the index cannot be written; the former one remains.
        """
        if self._signers(row.model_id).model.metric != "l2":
            raise InvalidRequest(
                f"Map {row.name!r} has no index, because its model stores full Fisher vectors, and "
                "queries compare all of them. If this takes too long, switch the model with "
                "`sceneprint reencode`."
            )
        version = self._publish(row, force=True, rebuild=True)
        if version is None:
            raise BusyIndex(
                f"The index of map {row.name!r} is being built by another process. Try again later."
            )
        return version

    def publish_next(self, row: MapRow) -> IndexVersion | None:
        """Publish the index of the next model of a map before the switch, if the map is large
        enough.

        Write errors are logged; the map then switches without an index.

        Returns
        -------
        version : newest index of the next model; None if there is no index

        Raises
        ------
        UnknownMap : If the map no longer exists.
        BusyIndex : If another process is building the index.
        """
        if row.next_model_id is None:
            raise ValueError(f"map {row.name} has no next model")
        next_row = replace(row, model_id=row.next_model_id)
        model = self._signers(next_row.model_id).model
        if model.metric != "l2":
            return None
        try:
            if self._publish(next_row) is None:
                with self._store.database.read() as connection:
                    if self._is_due(connection, next_row):
                        raise BusyIndex(
                            f"Another process is building the index of map {row.name!r} for the "
                            "model that it is switching to. Wait until the switch is done."
                        )
            self._place.sync(next_row)
            return self._newest(next_row, model)
        except (OSError, ValueError, UnusableStore, DamagedIndex) as error:
            log.error("index publication failed", extra={"map": row.name, "error": str(error)})
            return None

    def _try_publish(self, row: MapRow, *, force: bool = False) -> bool:
        try:
            if force and self._place.is_shared:
                self._place.sync(row)  # download removed parts again
                return False
            return self._publish(row, force=force) is not None
        except UnknownMap:
            return False
        except (OSError, SceneprintError, ValueError) as error:
            log.error("index publication failed", extra={"map": row.name, "error": str(error)})
            if self._place.is_shared:
                self._elsewhere[row.number] = time.monotonic() + ELSEWHERE_S
            return False

    def _metric(self, model_id: str) -> Metric | None:
        """Return the metric of a model; None if another version of sceneprint stored the model.

        That version then maintains the indexes of its maps.
        """
        if model_id not in self._metrics:
            self._metrics[model_id] = None
            with suppress(SceneprintError):
                self._metrics[model_id] = self._signers(model_id).model.metric
        return self._metrics[model_id]

    def _is_due(self, connection: Connection, row: MapRow) -> bool:
        number, since = self._published.get((row.number, row.model_id), (None, 0))
        if not self._place.is_shared and newest_number(self._place.folder(row)) != number:
            since = 0  # unknown: another process published or removed the index
        return self._is_outdated(connection, row, since)

    def _is_outdated(self, connection: Connection, row: MapRow, since: int) -> bool:
        """Return whether an index at revision `since` must be updated.

        This is so if it lacks too many frames or deletions, or will soon be too old to be updated.
        """
        if since < row.pruned_revision:
            since = 0
        if since and self._is_aging(connection, row, since):
            return True
        if row.revision - since <= self._tail_frames:  # this avoids counting rows
            return False
        return count_indexed(connection, row.number, since) > self._tail_frames or (
            count_gone(connection, row.number, since) > self._tail_frames
        )

    def _is_aging(self, connection: Connection, row: MapRow, since: int) -> bool:
        """Return whether an index contains a frame whose deletion is past half of its lifetime."""
        key = (row.number, row.model_id)
        if row.revision == since or time.monotonic() < self._aged.get(key, 0):
            return False
        before = read_clock(connection) - self._rows_s / 2
        if newest_deletion(connection, row.number, before) > since:
            return True
        self._aged[key] = time.monotonic() + min(self._rows_s / 24, AGING_S)
        return False

    def purge(self, row: MapRow) -> bool:
        """Rewrite the local and the shared index of a map without bytes of deleted frames.

        Returns
        -------
        is_rewritten : whether the index contained deleted frames

        Raises
        ------
        UnknownMap : If the map no longer exists; its index is removed soon.
        BusyIndex : If another process is building the index, possibly with deleted frames.
        OSError, UnusableStore : If the index cannot be written; the former index remains.
        """
        if self._metric(row.model_id) == "l1":
            return False
        head = self._place.head(row)
        with self._store.database.read() as connection:
            now = replace(find_map(connection, row.name), model_id=row.model_id)
            if now.number != row.number:
                return False
            empty = count_indexed(connection, row.number, 0) == 0
            older = now.pruned_revision > 0 or count_gone(connection, row.number, 0) > 0
        stale = head is not None and bool(self._place.stale_keys(now, head))
        done = True
        if stale and not empty:
            done = self._publish(row, force=True, clean=True) is not None
        if done and older:  # this also removes files of killed builders
            head = None if empty else self._place.head(row)
            done = self._place.remove_all_but(row, head)
        if not done:
            raise BusyIndex(
                f"Another process is building the index of map {row.name!r}, so the index may "
                "still contain bytes of deleted frames. Try again later."
            )
        return stale

    def postpone_purge(self, row: MapRow, seconds: float) -> None:
        """Postpone the next purge of the index of a map by `seconds`, for all processes."""
        now = time.time()
        with suppress(OSError):
            mark = self._place.folder(row) / _PURGED
            mark.touch(PRIVATE_FILE)
            os.utime(mark, (now, now + seconds))

    def is_purge_due(self, row: MapRow) -> bool:
        """Return whether the index of a map may be purged; see `postpone_purge`."""
        try:
            times = (self._place.folder(row) / _PURGED).stat()
        except OSError:
            return True
        # a purge is also due if the clock was set back
        return not times.st_atime <= time.time() < times.st_mtime

    def _publish(
        self, row: MapRow, *, force: bool = False, rebuild: bool = False, clean: bool = False
    ) -> IndexVersion | None:
        """Publish the index of a map if it is outdated or with `force`; return None if not
        published.

        With `rebuild`, reuse no earlier parts; with `clean`, reuse none that contain deleted
        frames.
        """
        if not force and self._is_up_to_date(row):
            return None
        with self._place.turn(row) as require:
            if require is None:  # another host is building the index
                self._elsewhere[row.number] = time.monotonic() + ELSEWHERE_S
                return None
            if not rebuild:
                self._place.sync(row)

            def share(manifest: IndexManifest) -> bool:
                require()
                return self._place.share(row, manifest)

            version = self._build(row, share, force=force, rebuild=rebuild, clean=clean)
            if version is None:
                return None
            self._place.prune(row, clean=clean)
        self._published[row.number, row.model_id] = version.number, version.revision
        log.info(
            "index published",
            extra={"map": row.name, "version": version.number, "frames": len(version)},
        )
        return version

    def _build(
        self, row: MapRow, share: Callable[[IndexManifest], bool], *, force: bool,
        rebuild: bool, clean: bool,
    ) -> IndexVersion | None:  # fmt: skip
        model = self._signers(row.model_id).model  # load it before the transaction
        after, damaged = self._place.last_number(row), list[int]()
        with self._store.database.read() as connection:
            allow(connection, 0)  # no time limit, since the connection is idle during the build
            now = find_map(connection, row.name)
            if row.model_id == now.next_model_id and is_complete(connection, now):
                now = replace(now, model_id=row.model_id)  # the map is about to switch
            if (now.number, now.model_id) != (row.number, row.model_id):
                return None  # the map was replaced or has switched its model
            previous = trusted(connection, now, None if rebuild else self._newest(now, model))
            since = 0 if previous is None else previous.revision
            if not force and not self._is_outdated(connection, now, since):
                return None  # already built by another worker
            if previous is None and count_indexed(connection, now.number, 0) == 0:
                if not rebuild:
                    return None
                raise InvalidRequest(
                    f"Map {now.name!r} has no indexed frame, so there is nothing to build."
                )
            version = publish(
                self._place.folder(now),
                model_id=now.model_id,
                revision=now.revision,
                blocks=_blocks(connection, now, since, damaged),
                previous=previous,
                drop=deleted_since(connection, now.number, since),
                anchor=partial(anchor_of_now, self._store.database, now.name),
                clean=clean,
                after=after,
                share=share,
            )
        resign_frames(self._store, now, damaged, now.model_id)
        return version

    def _is_up_to_date(self, row: MapRow) -> bool:
        """Return whether the newest index of a map, by its manifest, needs no update."""
        head = self._place.head(row)
        with self._store.database.read() as connection:
            now = replace(find_map(connection, row.name), model_id=row.model_id)
            usable = trusted(connection, now, head)
            since = 0 if usable is None else usable.revision
            if usable is not None:
                self._published[row.number, row.model_id] = usable.number, since
            return not self._is_outdated(connection, now, since)

    def _newest(self, row: MapRow, model: Model) -> IndexVersion | None:
        """Return the newest sound local index."""
        return newest(self._place.folder(row), row.model_id, model.signature_bytes)


def _blocks(
    connection: Connection, row: MapRow, since: int, damaged: list[int]
) -> Iterator[tuple[NDArray[np.int64], Bytes]]:
    """Yield keys and signatures since a revision; add damaged frames to `damaged`."""
    for block in changes_since(connection, row, since):
        lost = [change for change in block if change.vector is None and not change.deleted]
        damaged += [change.number for change in lost]
        signed = [(change.number, change.vector) for change in block if change.vector is not None]
        if signed:
            rows = np.stack([np.frombuffer(vector, np.uint8) for _, vector in signed])
            yield np.array([number for number, _ in signed], np.int64), rows
