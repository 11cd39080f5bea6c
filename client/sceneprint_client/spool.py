"""Spool in which a robot stores frames on disk while it is offline, to upload them later.

frame, meta  --Spool.add-->  a durable row of one SQLite file
rows, oldest first  --Spool.sync, Client.upload_batch-->  frames of a map, without duplicates
two places  --separation-->  their distance; a full spool drops frames with small distances
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sceneprint_client import errors
from sceneprint_client.api.base import FrameMeta, GivenPose
from sceneprint_client.api.frames import (
    MOST_OF_BATCH,
    BatchItem,
    SampleRange,
    UploadSummary,
    upload_summary,
)
from sceneprint_client.http import frame_bytes, meta_json
from sceneprint_client.poses import rotation_of
from sceneprint_client.tracker_core import difference
from sceneprint_client.uploads import upload_fields

if TYPE_CHECKING:
    from typing_extensions import Self

    from sceneprint_client.client import Client
    from sceneprint_client.http import FrameInput, MetaInput

T = TypeVar("T")

#: Default capacity of a new spool, bytes.
MOST_BYTES = 1 << 30
#: Metres, degrees and seconds that count as one unit of separation.
METRES, DEGREES, SECONDS = 1.0, 30.0, 60.0
#: Maximum size of the frames in one request, bytes; a larger frame is sent alone.
BATCH_BYTES = 4 << 20
#: Delay before the next request to a busy service that does not specify one, seconds.
_PAUSE_S = 1.0
#: Longest wait for another process's lock on the file, seconds.
_LOCKED_S = 30.0
#: Size of a page of the file, bytes. A frame occupies whole pages, and one page for its index rows.
_PAGE = 4096
#: Number of pages reserved for the journal on disk. Removing or rejecting the frames of one request
#: changes fewer pages, so these operations work on a full disk.
_RESERVE = 512
#: Application id that marks the file as a spool, and version of its schema.
_APPLICATION, _SCHEMA = 0x53705370, 1

# `frames.reason` is null for a waiting frame and '' for a rejected frame. Both need the same space,
# so a change does not rewrite the frame, which would fail on a full disk. `data` is the last
# column, so reading the other columns does not load it.
_TABLES = """
CREATE TABLE frames (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    digest TEXT NOT NULL UNIQUE,
    run TEXT NOT NULL,
    stamp REAL NOT NULL,
    pose TEXT,
    novelty REAL,
    bytes INTEGER NOT NULL,
    reason TEXT,
    meta TEXT NOT NULL,
    data BLOB NOT NULL
);
CREATE INDEX waiting_by_novelty ON frames (novelty, id) WHERE reason IS NULL;
CREATE INDEX waiting_by_run ON frames (run, id) WHERE reason IS NULL;
CREATE INDEX refused ON frames (id) WHERE reason IS NOT NULL;
CREATE TABLE counters (
    most_bytes INTEGER NOT NULL,
    bytes INTEGER NOT NULL DEFAULT 0,
    waiting INTEGER NOT NULL DEFAULT 0,
    refused INTEGER NOT NULL DEFAULT 0,
    uploaded INTEGER NOT NULL DEFAULT 0,
    thinned INTEGER NOT NULL DEFAULT 0,
    discarded INTEGER NOT NULL DEFAULT 0,
    queries INTEGER NOT NULL DEFAULT 0,
    queries_refused INTEGER NOT NULL DEFAULT 0,
    queries_sent INTEGER NOT NULL DEFAULT 0,
    queries_discarded INTEGER NOT NULL DEFAULT 0,
    queries_until REAL
);
CREATE TRIGGER added AFTER INSERT ON frames BEGIN
    UPDATE counters SET bytes = bytes + NEW.bytes, waiting = waiting + 1;
END;
CREATE TRIGGER removed AFTER DELETE ON frames BEGIN
    UPDATE counters SET bytes = bytes - OLD.bytes, waiting = waiting - (OLD.reason IS NULL),
        refused = refused - (OLD.reason IS NOT NULL);
END;
CREATE TRIGGER moved AFTER UPDATE OF reason ON frames BEGIN
    UPDATE counters SET waiting = waiting + (NEW.reason IS NULL) - (OLD.reason IS NULL),
        refused = refused + (NEW.reason IS NOT NULL) - (OLD.reason IS NOT NULL);
END;
CREATE TABLE reasons (frame INTEGER PRIMARY KEY, reason TEXT NOT NULL);
CREATE TRIGGER reason_removed AFTER DELETE ON frames WHEN OLD.reason IS NOT NULL BEGIN
    DELETE FROM reasons WHERE frame = OLD.id;
END;
CREATE TRIGGER reason_retried AFTER UPDATE OF reason ON frames WHEN NEW.reason IS NULL BEGIN
    DELETE FROM reasons WHERE frame = NEW.id;
END;
"""
#: Reason of a rejected frame whose reason could not be stored.
_NO_REASON = "The service refused the frame; the disk had no room to store the reason"


@dataclass(frozen=True)
class SpoolStatus:
    """Counts and sizes of a spool.

    Parameters
    ----------
    waiting : number of frames to upload
    refused : number of frames that the service rejected; `Spool.refusals` returns the reasons
    bytes, most_bytes : disk space of waiting and rejected frames, and its limit
    uploaded : number of frames uploaded since the spool was created
    thinned : number of waiting frames that a full spool dropped
    discarded : number of rejected frames that a full spool dropped
    oldest : capture time of the first waiting frame, or else the time at which it was added; None
        if no frame waits
    """

    waiting: int
    refused: int
    bytes: int
    most_bytes: int
    uploaded: int
    thinned: int
    discarded: int
    oldest: datetime | None


@dataclass(frozen=True)
class SpoolRefusal:
    """A frame that the service rejected, and the reason."""

    name: str | None
    session: str | None
    captured_at: datetime | None
    reason: str


@dataclass
class SyncReport:
    """Result of one `Spool.sync`.

    Parameters
    ----------
    received : number of frames that are new to the map
    there : number of frames that the map already had
    refused : number of frames that the service rejected
    poses : number of uploaded frames with a pose
    ranges : ranges of the uploaded frames
    """

    received: int = 0
    there: int = 0
    refused: int = 0
    poses: int = 0
    ranges: list[SampleRange] = field(default_factory=list)

    @property
    def summary(self) -> UploadSummary:
        """Return the summary of the uploaded frames."""
        return upload_summary(self.done, {"": self.done - self.poses}, self.ranges)

    @property
    def done(self) -> int:
        """Number of frames that no longer wait."""
        return self.received + self.there + self.refused


@dataclass(frozen=True, eq=False)
class SpoolPlace:
    """Time and pose of a frame.

    Parameters
    ----------
    stamp : seconds
    T : (4, 4) T_parent_sensor; None if unknown
    """

    stamp: float
    T: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class _Waiting:
    id: int
    data: bytes
    meta: FrameMeta


@dataclass(frozen=True)
class _Target:
    """Arguments of `Client.upload_batch`, and the time to wait for a busy service."""

    client: Client
    map_name: str
    how: dict[str, Any]
    until: float


class Spool:
    """Frames on disk until their upload; safe to share between threads and processes.

    A full spool first drops rejected frames. Then it drops the waiting frame with the smallest
    separation, in pose and time, from the frames before and after it in its run (one session of
    one robot). A metre, 30 degrees and a minute have the same weight. Without poses, only time
    counts. Of equal frames, the oldest is dropped. First and last frames of runs are dropped last.

    Parameters
    ----------
    path : path of the SQLite file, created if missing
    most_bytes : limit of the disk space of frames; default: the existing limit, or 1 GiB for a new
        spool

    Raises
    ------
    UnusableStore : If the file is not a spool, is damaged, or cannot be opened or written.
    InvalidRequest : If `most_bytes` is not positive.
    """

    def __init__(self, path: str | os.PathLike[str], most_bytes: int | None = None) -> None:
        if most_bytes is not None and most_bytes <= 0:
            raise errors.InvalidRequest(
                f"The limit of the spool is {most_bytes} bytes. Pass `most_bytes` above 0.",
                (("most_bytes", "not above 0"),),
            )
        self._path, self._lock = Path(path), RLock()
        with self._translated_errors():
            with suppress(OSError):  # frames are private; SQLite gives its journal the same mode
                self._path.touch(0o600)
            self._database = sqlite3.connect(
                self._path, timeout=_LOCKED_S, isolation_level=None, check_same_thread=False
            )
        try:
            self._open(most_bytes)
        except BaseException:
            self._database.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._database.close()

    def add(
        self, frame: FrameInput, meta: MetaInput | None = None,
        *, up: Sequence[float] | None = None,
    ) -> bool:  # fmt: skip
        """Store a frame until its upload. It is durable when this returns.

        Set `captured_at` in `meta`, since the service knows only the time of the upload.

        Parameters
        ----------
        frame, meta, up : see `Client.upload`

        Returns
        -------
        new : False if the spool already has the same content with the same metadata

        Raises
        ------
        StoreFull : If the disk is full; the spool is unchanged.
        InvalidRequest : If the frame is larger than `most_bytes`.
        FrameError, DatasetError : If the frame is empty, is a PNG without intrinsics, or is
            invalid in another way that `Client.upload` detects without decoding. Sidecar files
            are read only if `meta` is omitted.
        """
        data, metadata = frame_bytes(frame, meta, with_pose=True, up=up)
        _check_sendable(data, metadata)
        text = json.dumps(meta_json(metadata))
        digest = hashlib.sha256(text.encode() + b"\0" + data).hexdigest()
        size = (len(data) + len(text) + 2 * _PAGE - 1) // _PAGE * _PAGE
        with self._transaction() as database:
            most = database.execute("SELECT most_bytes FROM counters").fetchone()[0]
            if size > most:
                raise errors.InvalidRequest(
                    f"The frame takes {size} bytes, which exceeds the limit of {most} bytes of the "
                    f"spool {self._path}. Increase `most_bytes`, or send smaller frames.",
                    (("frame", "larger than the spool"),),
                )
            if database.execute("SELECT 1 FROM frames WHERE digest = ?", (digest,)).fetchone():
                return False
            while database.execute("SELECT bytes FROM counters").fetchone()[0] + size > most:
                _drop_frame(database)
            parent = None if metadata.pose is None else metadata.pose.parent_frame
            run = json.dumps([metadata.robot, metadata.session, parent])
            last = _neighbour(database, run, None, -1)
            stamp = metadata.captured_at.timestamp() if metadata.captured_at else time.time()
            T = pose_matrix(metadata.pose)
            pose = None if T is None else json.dumps(T.tolist())
            database.execute(
                "INSERT INTO frames (digest, run, stamp, pose, bytes, meta, data) "
                "VALUES (?, ?, ?, ?, ?, ?, ?)",
                (digest, run, stamp, pose, size, text, data),
            )
            _update_novelty(database, last)
        return True

    def status(self) -> SpoolStatus:
        """Return counts and sizes of the spool."""
        names = (
            "waiting", "refused", "bytes", "most_bytes", "uploaded", "thinned", "discarded",
        )  # fmt: skip
        with self._transaction(write=False) as database:
            row = database.execute(f"SELECT {', '.join(names)} FROM counters").fetchone()
            first = database.execute(
                "SELECT stamp FROM frames WHERE reason IS NULL ORDER BY id LIMIT 1"
            ).fetchone()
        oldest = None if first is None else datetime.fromtimestamp(first[0], timezone.utc)
        return SpoolStatus(**dict(zip(names, row, strict=True)), oldest=oldest)

    def refusals(self) -> list[SpoolRefusal]:
        """Return the frames that the service rejected, oldest first."""
        with self._transaction(write=False) as database:
            rows = database.execute(
                "SELECT meta, coalesce(reasons.reason, ?) FROM frames "
                "LEFT JOIN reasons ON frame = id WHERE frames.reason IS NOT NULL ORDER BY id",
                (_NO_REASON,),
            ).fetchall()
        refusals = [(FrameMeta.model_validate_json(text), reason) for text, reason in rows]
        return [
            SpoolRefusal(meta.name, meta.session, meta.captured_at, reason)
            for meta, reason in refusals
        ]

    def retry_refused(self) -> int:
        """Queue the rejected frames again and return their number."""
        with self._transaction() as database:
            query = "UPDATE frames SET reason = NULL WHERE reason IS NOT NULL"
            return database.execute(query).rowcount

    def sync(
        self, client: Client, map_name: str, *, priority: int = 0,
        if_novel: float | bool | None = None, patience_s: float = 120.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> SyncReport:  # fmt: skip
        """Upload the waiting frames, oldest first, and remove them from the spool; return counts.

        After an error or a crash call it again: the service recognises frames that the map already
        has, so no frame is lost or duplicated. A frame that the service rejects (409, 413, 415,
        422) is stored with the reason, and the upload continues with the next one.

        Parameters
        ----------
        client : client of the service
        map_name : map that receives the frames
        priority, if_novel : see `Client.upload`
        patience_s : total time to wait while the service is busy, seconds
        progress : function that is called after each request with (done, total) frames

        Raises
        ------
        Unreachable : If the service does not answer. After every error the remaining frames stay
            in the spool.
        Busy, RateLimited, QuotaExceeded, StoreAway, StoreLocked, StoreFull, NewerSchema, Refused :
            If the service accepts no more frames now.
        UnknownMap, KeyRequired, Forbidden : If the map or the key is wrong.
        UnusableStore : If the spool cannot be written.
        """
        how = {"priority": priority, "if_novel": if_novel}
        upload_fields(priority, if_novel)  # an invalid argument must not reject any frame
        target = _Target(client, map_name, how, time.monotonic() + patience_s)
        with self._transaction() as database:
            # This write detects a read-only file before any frame is sent.
            database.execute(f"PRAGMA user_version = {_SCHEMA}")
            query = "SELECT count(*), max(id) FROM frames WHERE reason IS NULL"
            total, last = database.execute(query).fetchone()
        report = SyncReport()
        while total and (batch := self._next_batch(last)):
            self._send(target, batch, report)
            if progress is not None:
                progress(report.done, max(total, report.done))
        return report

    # Uploads.

    def _next_batch(self, last: int) -> list[_Waiting]:
        """Return the first waiting frames with ids up to `last`, as many as fit one request."""
        with self._transaction(write=False) as database:
            rows = database.execute(
                "SELECT id, length(data) FROM frames WHERE reason IS NULL AND id <= ? "
                "ORDER BY id LIMIT ?",
                (last, MOST_OF_BATCH),
            ).fetchall()
            count, size = 0, 0
            for _, length in rows:
                size += length
                if count and size > BATCH_BYTES:
                    break
                count += 1
            query = "SELECT id, data, meta FROM frames WHERE id = ?"
            waiting = [database.execute(query, (number,)).fetchone() for number, _ in rows[:count]]
        return [
            _Waiting(number, data, FrameMeta.model_validate_json(meta))
            for number, data, meta in waiting
        ]

    def _send(self, target: _Target, batch: list[_Waiting], report: SyncReport) -> None:
        """Upload a batch and record the results; split the batch if it is rejected as a whole.

        Raise the error of an answer that is not about the frames, such as an exceeded quota.
        """
        try:
            items = _persist(
                target,
                lambda: target.client.upload_batch(
                    target.map_name, [row.data for row in batch], [row.meta for row in batch],
                    **target.how,
                ),
            )  # fmt: skip
        except errors.SceneprintError as error:
            if not _is_about_content(error) or (
                len(batch) == 1 and isinstance(error, errors.SlowBody)
            ):
                raise
            if len(batch) == 1:
                self._record_results([], {batch[0].id: str(error)})
                report.refused += 1
                return
            half = len(batch) // 2
            self._send(target, batch[:half], report)
            self._send(target, batch[half:], report)
            return
        uploaded, refused, last_item = [], {}, None
        for frame, item in zip(batch, items, strict=True):
            if item.frame is not None:
                uploaded.append(frame.id)
                report.received += item.status != 200
                report.there += item.status == 200
                report.poses += item.frame.has_pose
                if item.frame.samples is not None:
                    report.ranges.append(item.frame.samples)
            elif item.status in _FRAME_STATUSES:
                refused[frame.id] = item.problem.detail if item.problem else "no reason was stated"
            else:
                last_item = item
        self._record_results(uploaded, refused)
        report.refused += len(refused)
        if last_item is not None:
            raise _error_of(last_item)

    def _record_results(self, uploaded: list[int], refused: dict[int, str]) -> None:
        """Remove uploaded frames by id, and mark `refused` frames with their reasons."""
        with self._transaction() as database:
            for number in uploaded:
                removed = database.execute("DELETE FROM frames WHERE id = ?", (number,)).rowcount
                database.execute("UPDATE counters SET uploaded = uploaded + ?", (removed,))
            database.executemany(
                "UPDATE frames SET reason = '' WHERE id = ?", [(number,) for number in refused]
            )
        if not refused:
            return
        # A full disk may have no room for the reasons; `refusals` then returns a placeholder.
        with suppress(errors.StoreFull), self._transaction() as database:
            database.executemany(
                "INSERT OR REPLACE INTO reasons SELECT id, ? FROM frames "
                "WHERE id = ? AND reason IS NOT NULL",
                [(reason, number) for number, reason in refused.items()],
            )

    # The file.

    def _open(self, most_bytes: int | None) -> None:
        """Create the tables; for an existing spool, check them and set its limit."""
        with self._translated_errors():
            self._database.execute("PRAGMA journal_mode = PERSIST")
            self._database.execute("PRAGMA synchronous = FULL")
            # With secure_delete, the default in Debian, removing a frame would write all of its
            # pages to the journal.
            self._database.execute("PRAGMA secure_delete = OFF")
        with self._transaction() as database:
            mark = database.execute("PRAGMA application_id").fetchone()[0]
            schema = database.execute("PRAGMA user_version").fetchone()[0]
            tables = database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
            if tables and (mark, schema) != (_APPLICATION, _SCHEMA):
                raise errors.UnusableStore(
                    f"{self._path}: This is not a spool, or another version of sceneprint-client "
                    "wrote it. Specify another file, or use that version."
                )
            if not tables:
                for statement in _statements(_TABLES):
                    database.execute(statement)
                database.execute(f"PRAGMA application_id = {_APPLICATION}")
                database.execute(f"PRAGMA user_version = {_SCHEMA}")
                database.execute(
                    "INSERT INTO counters (most_bytes) VALUES (?)", (most_bytes or MOST_BYTES,)
                )
            elif most_bytes is not None:
                database.execute("UPDATE counters SET most_bytes = ?", (most_bytes,))
        self._reserve_journal()

    def _reserve_journal(self) -> None:
        """Reserve disk space for the journal, which retains its size after each transaction.

        Removing frames writes to the journal, so without the reserve a full disk would stay full.
        """
        journal = self._path.with_name(self._path.name + "-journal")
        if journal.is_file() and journal.stat().st_size >= _RESERVE * _PAGE:
            return
        with suppress(errors.StoreFull):  # the next call tries again
            with self._transaction() as database:
                database.execute("CREATE TABLE IF NOT EXISTS reserve (data BLOB)")
                page = [(bytes(_PAGE // 2 + 1024),)]  # a page holds only one of these rows
                database.executemany("INSERT INTO reserve VALUES (?)", page * _RESERVE)
            with self._transaction() as database:  # only existing pages are written to the journal
                database.execute("UPDATE reserve SET data = CAST(x'01' || data AS BLOB)")
                database.execute("DROP TABLE reserve")

    @contextmanager
    def _transaction(self, *, write: bool = True) -> Iterator[sqlite3.Connection]:
        """Yield the database in a transaction, which is rolled back after an error."""
        with self._lock, self._translated_errors():
            self._database.execute("BEGIN IMMEDIATE" if write else "BEGIN")
            try:
                yield self._database
                self._database.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):
                    if self._database.in_transaction:
                        self._database.execute("ROLLBACK")
                raise

    @contextmanager
    def _translated_errors(self) -> Iterator[None]:
        """Convert SQLite errors by their messages; Python 3.10 does not expose error codes."""
        try:
            yield
        except sqlite3.Error as error:
            if "full" in str(error):
                raise errors.StoreFull(
                    f"{self._path}: The disk has no room for the spool ({error}); nothing was "
                    "changed. Free some space, or upload frames: `sceneprint spool FILE --to MAP`."
                ) from error
            if "locked" in str(error):
                raise errors.StoreLocked(
                    f"{self._path}: Another process has locked the spool for more than "
                    f"{_LOCKED_S:.0f} s. Stop it, or try again."
                ) from error
            raise errors.UnusableStore(
                f"{self._path}: The spool cannot be used ({error}); nothing was changed. Check the "
                "path, its permissions and the disk."
            ) from error


def _check_sendable(data: bytes, meta: FrameMeta) -> None:
    """Raise FrameError if the service would reject the frame, while the robot can still fix it."""
    if not data:
        raise errors.UnreadableFrame("The frame is empty. Write it again.")
    if data.startswith(b"\x89PNG") and meta.intrinsics is None:
        raise errors.InvalidIntrinsics(
            "The frame is a depth image, but its intrinsics are missing. Pass `intrinsics` in "
            "`meta`; intrinsics.json beside the file is read only if `meta` is omitted."
        )


# Thinning of a full spool.


def separation(a: SpoolPlace, b: SpoolPlace) -> float:
    """Return metres + degrees / 30 + seconds / 60 between two frames, or only the time if a pose is
    unknown.
    """
    apart = abs(a.stamp - b.stamp) / SECONDS
    if a.T is None or b.T is None:
        return apart
    metres, radians = difference(a.T, b.T)
    return apart + metres / METRES + math.degrees(radians) / DEGREES


def pose_matrix(pose: GivenPose | None) -> NDArray[np.float64] | None:
    """Return a pose as (4, 4); None if it is missing or invalid."""
    if pose is None:
        return None
    T = np.eye(4)
    if pose.matrix is not None:
        T = np.array(pose.matrix, np.float64)
    elif pose.translation is not None and pose.rotation is not None:
        p, q = pose.translation, pose.rotation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        norm = float(np.linalg.norm(quaternion))
        if not norm > 0:
            return None
        T[:3, :3], T[:3, 3] = rotation_of(quaternion / norm), (p.x, p.y, p.z)
    return T if np.isfinite(T).all() else None


def _drop_frame(database: sqlite3.Connection) -> None:
    """Drop the least valuable frame; see Spool."""
    row = database.execute("SELECT id FROM frames WHERE reason IS NOT NULL ORDER BY id").fetchone()
    if row is not None:
        database.execute("DELETE FROM frames WHERE id = ?", row)
        database.execute("UPDATE counters SET discarded = discarded + 1")
        return
    row = database.execute(
        "SELECT id, run FROM frames WHERE reason IS NULL AND novelty IS NOT NULL "
        "ORDER BY novelty, id LIMIT 1"
    ).fetchone()
    if row is None:
        row = database.execute(
            "SELECT id, run FROM frames WHERE reason IS NULL ORDER BY id LIMIT 1"
        ).fetchone()
    number, run = row
    before, after = _neighbour(database, run, number, -1), _neighbour(database, run, number, 1)
    database.execute("DELETE FROM frames WHERE id = ?", (number,))
    database.execute("UPDATE counters SET thinned = thinned + 1")
    _update_novelty(database, before)
    _update_novelty(database, after)


def _neighbour(database: sqlite3.Connection, run: str, number: int | None, side: int) -> int | None:
    """Return the waiting frame before (-1) or after (1) an id; for id None, the run's last."""
    order, compared = ("DESC", "<") if side < 0 else ("ASC", ">")
    row = database.execute(
        f"SELECT id FROM frames WHERE reason IS NULL AND run = ? AND id {compared} ? "
        f"ORDER BY id {order} LIMIT 1",
        (run, 2**63 - 1 if number is None else number),
    ).fetchone()
    return None if row is None else int(row[0])


def _update_novelty(database: sqlite3.Connection, number: int | None) -> None:
    """Store the sum of a frame's separations from its two neighbours; null at the ends of a run."""
    if number is None:
        return
    query = "SELECT run, stamp, pose FROM frames WHERE id = ?"
    run, *own = database.execute(query, (number,)).fetchone()
    places: list[SpoolPlace] = []
    for side in (-1, 1):
        beside = _neighbour(database, run, number, side)
        if beside is None:
            places = []
            break
        places.append(_place(*database.execute(query, (beside,)).fetchone()[1:]))
    novelty = sum(separation(_place(*own), place) for place in places) if places else None
    database.execute("UPDATE frames SET novelty = ? WHERE id = ?", (novelty, number))


def _place(stamp: float, pose: str | None) -> SpoolPlace:
    return SpoolPlace(stamp, None if pose is None else np.array(json.loads(pose)))


def _statements(script: str) -> Iterator[str]:
    """Yield the statements of a script; `executescript` would commit the transaction."""
    statement = ""
    for line in script.splitlines(keepends=True):
        statement += line
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""


# Answers of the service.

#: Status codes that concern a single frame, so the upload continues with the next frame.
_FRAME_STATUSES = (400, 409, 413, 415, 422)


def _is_about_content(error: errors.SceneprintError) -> bool:
    """Return whether the service refused a request because of its content."""
    if isinstance(error, errors.Refused):  # an answer of a proxy, or an unknown problem
        return error.status in (409, 413, 415, 422)
    return isinstance(error, (errors.FrameError, errors.Conflict, errors.InvalidRequest))


def _persist(target: _Target, send: Callable[[], T]) -> T:
    """Return the result of `send`; repeat the call while the service is busy and time is left."""
    while True:
        try:
            return send()
        except errors.SceneprintError as error:
            pause = max(error.retry_after_s, _PAUSE_S)
            if not error.retry_after_s or time.monotonic() + pause > target.until:
                raise
        time.sleep(pause)


def _error_of(item: BatchItem) -> errors.SceneprintError:
    """Return the error for an item whose status shows that the service accepts no more frames."""
    detail = "The service rejected a frame." if item.problem is None else item.problem.detail
    if item.status == 403:
        return errors.QuotaExceeded(detail)
    return errors.Refused(detail, item.status, item.problem.model_dump() if item.problem else {})
