"""Answers of queries, kept for a while so that one can look at them afterwards.

    Kept  --keep-->  a file  --find-->  Kept

A convenience, and treated as one: a file each, not durable, bounded in bytes, number and age, the
oldest removed first. What cannot be kept costs no query its answer, and what is damaged is not
there. Several processes share the folder.
"""

from __future__ import annotations

import json
import logging
import os
import re
import struct
import threading
import time
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from sceneprint.errors import UnknownQuery
from sceneprint.schemas import Answer, Query
from sceneprint.store.filters import Taken
from sceneprint.types import Bytes, Floats
from sceneprint.writing import write_whole

log = logging.getLogger(__name__)

#: Most answers that are kept, however small: a folder is read again for every few.
MOST_QUERIES = 10_000
#: Of the bytes and of what they mean. Raise it when either changes.
SCHEMA_VERSION = 2
_MAGIC = b"SPQRY"
#: magic, schema, CRC-32 of all that follows | bytes of head, signature and geometry artifact
_FILE, _PARTS = struct.Struct("<5sHI"), struct.Struct("<III")
#: No artifact may be opened by a name that could leave the folder.
_ID = re.compile(r"[0-9a-f]{32}")
#: Answers after which a process looks at the folder again, for what others have put there.
_LOOK = 16
#: Share of the bounds that is left after removing: not every answer should remove one.
_LEAVE = 0.9
#: Seconds after which half a file is of a process that died.
_ABANDONED_S = 60.0


@dataclass(frozen=True, eq=False)
class Kept:
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
    """

    answer: Answer
    query: Query
    model_id: str
    vector: Bytes
    geometry: bytes | None
    ranked: tuple[int, ...] = ()
    at: float = field(default_factory=time.time)
    taken: Taken = field(default_factory=lambda: Taken(None, None, None))
    base: tuple[str, Floats] | None = None


class KeptQueries:
    """A folder of answers.

    Parameters
    ----------
    folder : made when the first answer is kept
    seconds : how long each is kept
    most_bytes : of all together; 0 keeps none
    """

    def __init__(self, folder: Path, seconds: float, most_bytes: int) -> None:
        self._folder, self._seconds, self._most = folder, seconds, most_bytes
        self._lock = threading.Lock()
        self._left = 0  # answers until the folder is looked at again
        self._room = 0  # bytes until then
        self._refused = False  # whether the last answer could not be kept

    def keep(self, kept: Kept) -> bool:
        """Keep an answer; False where that cannot be done, which is nobody's error."""
        data = _written(kept)
        if len(data) > self._most:
            return False
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._make_room(len(data))
            write_whole(self._folder / kept.answer.query_id, data)
        except OSError as error:  # a full disk, a folder that may only be read
            if not self._refused:  # once, and not with every query
                log.warning("answers cannot be kept", extra={"error": str(error)})
            self._refused = True
            return False
        self._refused = False
        return True

    def find(self, query_id: str) -> Kept:
        """The answer of that id.

        Raises
        ------
        UnknownQuery : there is none, or no longer, or it cannot be read.
        """
        if _ID.fullmatch(query_id):
            try:
                path = self._folder / query_id
                if path.stat().st_mtime + self._seconds > time.time():
                    return _read(path.read_bytes())
            except (OSError, ValueError, KeyError, ValidationError, struct.error):
                pass
        raise unknown_query(query_id)

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
                    whole = _ID.fullmatch(entry.name) is not None
                    age = now - found.st_mtime
                    if age > (self._seconds if whole else _ABANDONED_S):
                        _remove(entry.path)
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
                _remove(path)
            self._left, self._room = _LOOK, self._most - total


def unknown_query(query_id: str) -> UnknownQuery:
    """One text for what there never was, what has gone, and what the caller may not see."""
    return UnknownQuery(
        f"There is no answer {query_id!r:.80}, or no longer: answers are kept for a while only. "
        "Ask again, with `keep` left as it is."
    )


def _remove(path: str) -> None:
    Path(path).unlink(missing_ok=True)


def _written(kept: Kept) -> bytes:
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
        }
    ).encode()
    parts = [head, kept.vector.tobytes(), kept.geometry or b""]
    body = _PARTS.pack(*map(len, parts)) + b"".join(parts)
    return _FILE.pack(_MAGIC, SCHEMA_VERSION, zlib.crc32(body)) + body


def _read(data: bytes) -> Kept:
    """An answer from its bytes; ValueError and others where they are none."""
    magic, schema, checksum = _FILE.unpack_from(data)
    body = data[_FILE.size :]
    if magic != _MAGIC or schema != SCHEMA_VERSION or zlib.crc32(body) != checksum:
        raise ValueError("not an answer, or damaged")
    ends = np.cumsum([_PARTS.size, *_PARTS.unpack_from(body)]).tolist()
    head = json.loads(body[ends[0] : ends[1]])
    return Kept(
        answer=Answer.model_validate(head["answer"]),
        query=Query.model_validate(head["query"]),
        model_id=head["model_id"],
        vector=np.frombuffer(body[ends[1] : ends[2]], np.uint8),
        geometry=body[ends[2] : ends[3]] if head["geometry"] else None,
        ranked=tuple(head["ranked"]),
        at=head["at"],
        taken=Taken(**head["taken"]),
        base=None if head["base"] is None else (head["base"][0], np.array(head["base"][1])),
    )
