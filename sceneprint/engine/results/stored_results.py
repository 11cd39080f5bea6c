"""Answers of queries, kept for a while so that one can look at them afterwards.

    Kept  --written-->  bytes  --read-->  Kept

A convenience, and treated as one: a file or an object each, not durable, bounded in bytes, number
and age, the oldest removed first. What cannot be kept costs no query its answer, and what is
damaged is not there. Several processes share them.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import struct
import threading
import time
import zlib
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from sqlalchemy import ColumnElement, select

from sceneprint.atomic_files import make_folder, write_whole
from sceneprint.errors import UnknownQuery, UnusableStore
from sceneprint.settings import Settings
from sceneprint.store import Blobs, Store
from sceneprint.store.blobs.object_client import ListedObject, Objects
from sceneprint.store.blobs.object_store import ObjectBlobs
from sceneprint.store.frame_queries import QueryOrigin
from sceneprint.store.tables import frames, maps
from sceneprint.types import Bytes, Floats
from sceneprint_client.api import Answer, FrameState, Query

log = logging.getLogger(__name__)

#: Most answers that are kept, however small: a folder is read again for every few.
MOST_QUERIES = 10_000
#: Of the bytes and of what they mean. Raise it when either changes; `kept_answers` has some of any
#: age, so `read` must go on reading what versions before wrote.
SCHEMA_VERSION = 2
_MAGIC = b"SPQRY"
#: magic, schema, CRC-32 of all that follows | bytes of head, signature and geometry artifact
_FILE, _PARTS = struct.Struct("<5sHI"), struct.Struct("<III")
#: No answer may be opened by a name that could lead elsewhere.
ID = re.compile(r"[0-9a-f]{32}")
#: Bytes in which most heads lie whole.
HEAD = 16 << 10
#: What is raised where bytes are no answer, or a damaged one.
DAMAGED = (ValueError, KeyError, TypeError, ValidationError, struct.error)


@dataclass(frozen=True, eq=False)
class StoredResult:
    """An answer, and what it was made from.

    Parameters
    ----------
    answer : as it was given
    query : as it was asked
    model_id : of the model that signed the query
    vector : (D,) its signature
    geometry : its artifact as bytes; None where the query was not validated
    ranked : numbers of the frames of R, in its order
    at : when, seconds since 1970
    taken : who took an uploaded query, in which run and when
    base : what its robot's base is called, and T_base_query (4, 4); None where it is not known
    up : (3,) unit vector in the query's sensor; None where it is not known
    """

    answer: Answer
    query: Query
    model_id: str
    vector: Bytes
    geometry: bytes | None
    ranked: tuple[int, ...] = ()
    at: float = field(default_factory=time.time)
    taken: QueryOrigin = field(default_factory=lambda: QueryOrigin(None, None, None))
    base: tuple[str, Floats] | None = None
    up: Floats | None = None


#: Whether an answer may still be looked at: of its head alone, the rest may be left out.
Stands = Callable[[StoredResult], bool]
#: An answer that is kept elsewhere, by its id; None where it is not.
Finds = Callable[[str], StoredResult | None]


def _nowhere(_: str) -> StoredResult | None:
    return None


class StoredResults(ABC):
    """Where answers are kept, in a folder (`ResultFolder`) or in objects (`ResultObjects`).

    Parameters
    ----------
    seconds : how long each is kept
    most_bytes : of all together; 0 keeps none
    stands : whether one that is found may still be looked at
    kept : finds those that are kept for longer
    """

    def __init__(
        self, seconds: float, most_bytes: int, stands: Stands = lambda _: True,
        kept: Finds = _nowhere,
    ) -> None:  # fmt: skip
        self._seconds, self._most, self._stands, self._kept = seconds, most_bytes, stands, kept
        self._refused = False  # whether the last answer could not be kept

    @abstractmethod
    def keep(self, kept: StoredResult) -> bool:
        """Keep an answer; False where that cannot be done, which is nobody's error."""

    def find(self, query_id: str) -> StoredResult:
        """The answer of that id.

        Raises
        ------
        UnknownQuery : there is none, or no longer, or it cannot be read.
        UnusableStore : the object store is away.
        """
        if ID.fullmatch(query_id):
            with suppress(OSError, *DAMAGED):
                found = self._read(query_id)
                if found is not None and self._stands(found):
                    return found
            found = self._kept(query_id)
            if found is not None and self._stands(found):
                return found
        raise unknown_query(query_id)

    @abstractmethod
    def forget(self, stands: Stands) -> int:
        """Remove what is too old, or does not stand; returns how many.

        Raises
        ------
        UnusableStore : the object store is away.
        """

    @abstractmethod
    def _read(self, query_id: str) -> StoredResult | None:
        """The answer that lies under an id; None where it is too old."""

    def _refuse(self, error: Exception) -> None:
        """Log that answers cannot be kept: once, and not with every query."""
        if not self._refused:
            log.warning("query results cannot be stored", extra={"error": str(error)})
        self._refused = True


def unknown_query(query_id: str) -> UnknownQuery:
    """One text for what there never was, what has gone, and what the caller may not see."""
    return UnknownQuery(
        f"There is no answer {query_id!r:.80}: it never existed, or it expired. Send the query "
        "again, without `keep=false`."
    )


def written(kept: StoredResult) -> bytes:
    """An answer as bytes."""
    head = json.dumps(
        {
            "answer": kept.answer.model_dump(mode="json"),
            # of a query to several maps without their names: the answer has them
            # as given: what was left out of `validation` is as the model has it
            "query": kept.query.model_dump(
                mode="json", include=set(Query.model_fields), exclude_unset=True
            ),
            "model_id": kept.model_id,
            "geometry": kept.geometry is not None,
            "ranked": kept.ranked,
            "at": kept.at,
            "taken": asdict(kept.taken),
            "base": None if kept.base is None else [kept.base[0], kept.base[1].tolist()],
            "up": None if kept.up is None else kept.up.tolist(),
        }
    ).encode()
    parts = [head, kept.vector.tobytes(), kept.geometry or b""]
    body = _PARTS.pack(*map(len, parts)) + b"".join(parts)
    return _FILE.pack(_MAGIC, SCHEMA_VERSION, zlib.crc32(body)) + body


def read(data: bytes) -> StoredResult:
    """An answer from its bytes; ValueError and others where they are none."""
    magic, schema, checksum = _FILE.unpack_from(data)
    body = data[_FILE.size :]
    if magic != _MAGIC or schema != SCHEMA_VERSION or zlib.crc32(body) != checksum:
        raise ValueError("not an answer, or damaged")
    ends = np.cumsum([_PARTS.size, *_PARTS.unpack_from(body)]).tolist()
    head = json.loads(body[ends[0] : ends[1]])
    vector = np.frombuffer(body[ends[1] : ends[2]], np.uint8)
    return _of(head, vector, body[ends[2] : ends[3]] if head["geometry"] else None)


def read_head(beginning: bytes, more: Callable[[int], bytes]) -> StoredResult:
    """An answer without signature and geometry; raises as `read`, but does not see all damage.

    Parameters
    ----------
    beginning : of its bytes, HEAD of them or all
    more : that many of them, from the first on
    """
    magic, schema, _ = _FILE.unpack_from(beginning)
    if magic != _MAGIC or schema != SCHEMA_VERSION:
        raise ValueError("not an answer")
    length, _, _ = _PARTS.unpack_from(beginning, _FILE.size)
    begin = _FILE.size + _PARTS.size
    if begin + length > len(beginning):
        beginning = more(begin + length)
    return _of(json.loads(beginning[begin : begin + length]), np.empty(0, np.uint8), None)


def _of(head: dict[str, Any], vector: Bytes, geometry: bytes | None) -> StoredResult:
    return StoredResult(
        answer=Answer.model_validate(head["answer"]),
        query=Query.model_validate(head["query"]),
        model_id=head["model_id"],
        vector=vector,
        geometry=geometry,
        ranked=tuple(head["ranked"]),
        at=head["at"],
        taken=QueryOrigin(**head["taken"]),
        base=None if head["base"] is None else (head["base"][0], np.array(head["base"][1])),
        # answers of before there was gravity are kept for an hour more
        up=None if head.get("up") is None else np.array(head["up"]),
    )


# Answers that are kept in a folder which the processes of one machine share.

#: Answers after which a process looks at the folder again, for what others have put there.
_LOOK = 16
#: Share of the bounds that is left after removing: not every answer should remove one.
_LEAVE = 0.9
#: Seconds after which half a file is of a process that died.
_ABANDONED_S = 60.0


class ResultFolder(StoredResults):
    """A folder of answers; see also StoredResults.

    Parameters
    ----------
    folder : made when the first answer is kept
    """

    def __init__(
        self, folder: Path, seconds: float, most_bytes: int, stands: Stands = lambda _: True,
        kept: Finds = _nowhere,
    ) -> None:  # fmt: skip
        super().__init__(seconds, most_bytes, stands, kept)
        self._folder = folder
        self._lock = threading.Lock()
        self._left = 0  # answers until the folder is looked at again
        self._room = 0  # bytes until then

    def keep(self, kept: StoredResult) -> bool:
        """Keep an answer; see `StoredResults.keep`."""
        data = written(kept)
        if len(data) > self._most:
            return False
        try:
            make_folder(self._folder)
            self._make_room(len(data))
            write_whole(self._folder / kept.answer.query_id, data, private=True)
        except OSError as error:  # a full disk, a folder that may only be read
            self._refuse(error)
            return False
        self._refused = False
        return True

    def _read(self, query_id: str) -> StoredResult | None:
        path = self._folder / query_id
        keeps = path.stat().st_mtime + self._seconds > time.time()
        return read(path.read_bytes()) if keeps else None

    def forget(self, stands: Stands) -> int:
        """Remove what is too old, or does not stand; see `StoredResults.forget`."""
        gone = 0
        for name in os.listdir(self._folder) if self._folder.is_dir() else ():  # noqa: PTH208
            path = self._folder / name
            try:
                if ID.fullmatch(name) and not self._keeps(path, stands):
                    path.unlink(missing_ok=True)
                    gone += 1
            except OSError:  # another process has removed it, or it cannot be
                continue
        return gone

    def _keeps(self, path: Path, stands: Stands) -> bool:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_mtime + self._seconds <= time.time():
                return False
            try:
                beginning = file.read(HEAD)
                found = read_head(beginning, lambda n: beginning + file.read(n - len(beginning)))
            except DAMAGED:
                return False
        return stands(found)

    def _make_room(self, size: int) -> None:
        """Remove what is too old, and the oldest of what is too much."""
        with self._lock:
            self._left -= 1
            self._room -= size
            if self._left >= 0 and self._room >= 0:
                return
            files, now = [], time.time()
            with os.scandir(self._folder) as entries:
                for entry in entries:
                    try:
                        found = entry.stat(follow_symlinks=False)
                    except FileNotFoundError:  # another process has removed it
                        continue
                    whole = ID.fullmatch(entry.name) is not None
                    age = now - found.st_mtime
                    if age > (self._seconds if whole else _ABANDONED_S):
                        Path(entry.path).unlink(missing_ok=True)
                    elif whole:
                        files.append((found.st_mtime_ns, found.st_size, entry.path))
            files.sort(reverse=True)
            total, fits = size, 0
            for _, one, _ in files:
                if total + one > self._most or fits + 1 >= MOST_QUERIES:
                    break
                total, fits = total + one, fits + 1
            if fits < len(files):  # make room for the next ones too
                while fits and (total > _LEAVE * self._most or fits > _LEAVE * MOST_QUERIES):
                    fits -= 1
                    total -= files[fits][1]
            for _, _, path in files[fits:]:
                Path(path).unlink(missing_ok=True)
            self._left, self._room = _LOOK, self._most - total


# Answers that are kept in the object store of a fleet: any API process finds what another gave.
#
#     PREFIX/queries/ID       an answer, as kept.py writes it
#     PREFIX/queries/.looked  when they were last gone through
#
# Each process removes its own when they are too old or too many, without listing; what processes
# left that have died goes when somebody goes through all of them, which one of the fleet does at a
# time.

_FOLDER, _LOOKED = "queries/", "queries/.looked"
#: Seconds that a query waits for its answer to be kept; then it goes on without.
WAIT_S = 0.5
#: Answers on their way at once; more are not kept.
_UNDER_WAY = 16
#: Objects that one request removes, and share of the time between two looks that others wait.
_AT_ONCE, _SHARE = 500, 0.9


class ResultObjects(StoredResults):
    """Answers under the prefix of an object store; see also StoredResults.

    Parameters
    ----------
    objects : of the prefix
    most_bytes : of those of each process, and of all when they are gone through
    purge_s : seconds after which nothing is left of what does not stand
    """

    def __init__(
        self, objects: Objects, seconds: float, most_bytes: int, purge_s: float = 3600.0,
        stands: Stands = lambda _: True, kept: Finds = _nowhere,
    ) -> None:  # fmt: skip
        super().__init__(seconds, most_bytes, stands, kept)
        self._objects, self._purge_s = objects, purge_s
        self._slots = threading.BoundedSemaphore(_UNDER_WAY)
        self._lock = threading.Lock()
        self._own: deque[ListedObject] = deque()  # the oldest first
        self._bytes = 0  # of those

    def keep(self, kept: StoredResult) -> bool:
        """Keep an answer; False where that is not done in time. See `StoredResults.keep`."""
        data = written(kept)
        if len(data) > self._most or not self._slots.acquire(blocking=False):
            return False
        done: list[bool] = []
        # of its own, and nobody waits for it in the end: a store that hangs costs no query more
        sending = threading.Thread(
            target=self._send, args=(kept.answer.query_id, data, done), daemon=True, name="keep"
        )
        try:
            sending.start()
        except RuntimeError:  # no more threads
            self._slots.release()
            return False
        sending.join(WAIT_S)
        return bool(done)

    def _send(self, query_id: str, data: bytes, done: list[bool]) -> None:
        try:
            self._objects.put(_FOLDER + query_id, data)
            done.append(True)
            self._refused = False
            gone = self._surplus(ListedObject(_FOLDER + query_id, len(data), time.time()))
            if gone:
                self._objects.delete(*gone)
        except UnusableStore as error:
            self._refuse(error)
        finally:
            self._slots.release()

    def _surplus(self, new: ListedObject) -> list[str]:
        """Keys of this process's that are too old or too many, beside a new one."""
        gone = []
        with self._lock:
            self._own.append(new)
            self._bytes += new.size
            old = new.changed_at - self._seconds
            while len(self._own) > 1 and (
                self._bytes > self._most
                or len(self._own) > MOST_QUERIES
                or self._own[0].changed_at < old
            ):
                one = self._own.popleft()
                self._bytes -= one.size
                gone.append(one.key)
        return gone

    def _read(self, query_id: str) -> StoredResult | None:
        found = read(self._objects.get(_FOLDER + query_id))
        return found if found.at + self._seconds > time.time() else None

    def forget(self, stands: Stands) -> int:
        """Remove what is too old, too much, or does not stand; see `StoredResults.forget`.

        Called everywhere every half of `purge_s`, and done once in the fleet: what would go by its
        age before the next time is not read.
        """
        now = time.time()
        last = self._objects.look(_LOOKED)
        if last is not None and now - last.changed_at < _SHARE * self._purge_s / 2:
            return 0
        self._objects.put(_LOOKED, b"")
        gone, total = list[str](), 0
        every = [one for one in self._objects.list(_FOLDER) if one.key != _LOOKED]
        for place, one in enumerate(sorted(every, key=lambda each: -each.changed_at)):
            total += one.size
            spent = one.changed_at + self._seconds <= now
            stays = one.changed_at + self._seconds > now + self._purge_s / 2
            if (
                spent
                or total > self._most
                or place >= MOST_QUERIES
                or (stays and not self._keeps(one, stands))
            ):
                gone.append(one.key)
        for start in range(0, len(gone), _AT_ONCE):
            self._objects.delete(*gone[start : start + _AT_ONCE])
        return len(gone)

    def _keeps(self, one: ListedObject, stands: Stands) -> bool:
        try:
            if one.size == 0:
                return False
            beginning = self._objects.part(one.key, 0, min(HEAD, one.size))
            return stands(read_head(beginning, lambda n: self._begin(one, n)))
        except FileNotFoundError:
            return True  # another has removed it
        except DAMAGED:
            return False

    def _begin(self, one: ListedObject, length: int) -> bytes:
        if length > one.size:
            raise ValueError("damaged: it is shorter than its header says")
        return self._objects.part(one.key, 0, length)


# Where the answers of queries are kept: beside the blobs, so that who shares those finds them.


def open_results(
    settings: Settings, blobs: Blobs, stands: Stands = lambda _: True, kept: Finds = _nowhere
) -> StoredResults:
    """Answers as the settings want them kept; `stands` and `kept`: see StoredResults."""
    seconds, most = settings.query_s, settings.query_bytes
    if isinstance(blobs, ObjectBlobs):
        return ResultObjects(blobs.objects, seconds, most, settings.purge_s, stands, kept)
    return ResultFolder(settings.query_dir, seconds, most, stands, kept)


# Whether what was made of frames and maps still stands, or one of them was deleted since.


class ResultValidity:
    """Looks frames and maps up, once each: of one moment, so make a new one for the next.

    Parameters
    ----------
    store : see Store
    restorable : whether a deleted frame still counts while it can be restored
    """

    def __init__(self, store: Store, *, restorable: bool = False) -> None:
        self._store = store
        self._there: ColumnElement[bool] = frames.c.state != FrameState.DELETED
        if restorable:
            self._there |= frames.c.deletion.is_not(None)
        self._maps: dict[str, float | None] = {}  # when they were made, seconds since 1970
        self._frames: dict[tuple[str, str], float | None] = {}  # when they were received

    def asked(self, kept: StoredResult) -> bool:
        """Whether the maps that were asked are still those, and the frame that was looked up is
        there, or one that has its id since: whoever asks again is told of that.
        """
        frame = kept.answer.frame
        return all(self.map(name, kept.at) for name in kept.answer.maps) and (
            frame is None or self.frame(frame.map, frame.frame_id, math.inf)
        )

    def all_of(self, kept: StoredResult) -> bool:
        """Whether all frames that an answer was made from and shows are still those too."""
        own, matches = kept.answer.frame, kept.answer.matches
        shown = {(one.map, one.frame_id) for one in matches}
        shown |= set() if own is None else {(own.map, own.frame_id)}
        self._look_up(shown)
        return self.asked(kept) and all(self.frame(*place, kept.at) for place in shown)

    def map(self, name: str, at: float) -> bool:
        """Whether a map is there that was there at that time, seconds since 1970."""
        if name not in self._maps:
            with self._store.database.read() as connection:
                asked = select(maps.c.created_at).where(maps.c.name == name)
                self._maps[name] = connection.execute(asked).scalar()
        made = self._maps[name]
        return made is not None and made <= at

    def frame(self, map_name: str, frame_id: str, at: float) -> bool:
        """Whether a frame is there that was there at that time."""
        self._look_up({(map_name, frame_id)})
        received = self._frames[map_name, frame_id]
        return received is not None and received <= at

    def _look_up(self, places: set[tuple[str, str]]) -> None:
        """Ask for all frames that are not known yet at once: there are thousands of answers."""
        new = places - self._frames.keys()
        if not new:
            return
        for place in new:
            self._frames[place] = None
        with self._store.database.read() as connection:
            for name in {name for name, _ in new}:
                found = connection.execute(
                    select(frames.c.id, frames.c.received_at)
                    .join(maps, maps.c.number == frames.c.map_number)
                    .where(
                        maps.c.name == name,
                        frames.c.id.in_([frame_id for of, frame_id in new if of == name]),
                        self._there,
                    )
                )
                self._frames.update({(name, frame_id): at for frame_id, at in found})
