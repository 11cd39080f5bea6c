"""Answers of queries, kept for a while so that one can look at them afterwards.

    Kept  --written-->  bytes  --read-->  Kept

A convenience, and treated as one: a file or an object each, not durable, bounded in bytes, number
and age, the oldest removed first. What cannot be kept costs no query its answer, and what is
damaged is not there. Several processes share them.
"""

from __future__ import annotations

import json
import re
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import numpy as np
from pydantic import ValidationError

from sceneprint.errors import UnknownQuery
from sceneprint.schemas import Answer, Query
from sceneprint.store.filters import Taken
from sceneprint.types import Bytes, Floats

#: Most answers that are kept, however small: a folder is read again for every few.
MOST_QUERIES = 10_000
#: Of the bytes and of what they mean. Raise it when either changes.
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


#: Whether an answer may still be looked at: of its head alone, the rest may be left out.
Stands = Callable[[Kept], bool]


class KeptQueries(Protocol):
    """Where answers are kept, in a folder (kept_folder.py) or in objects (kept_objects.py)."""

    def keep(self, kept: Kept) -> bool:
        """Keep an answer; False where that cannot be done, which is nobody's error."""

    def find(self, query_id: str) -> Kept:
        """The answer of that id.

        Raises
        ------
        UnknownQuery : there is none, or no longer, or it cannot be read.
        UnusableStore : the object store is away.
        """

    def forget(self, stands: Stands) -> int:
        """Remove what is too old, or does not stand; returns how many.

        Raises
        ------
        UnusableStore : the object store is away.
        """


def unknown_query(query_id: str) -> UnknownQuery:
    """One text for what there never was, what has gone, and what the caller may not see."""
    return UnknownQuery(
        f"There is no answer {query_id!r:.80}, or no longer: answers are kept for a while only. "
        "Ask again, with `keep` left as it is."
    )


def written(kept: Kept) -> bytes:
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
        }
    ).encode()
    parts = [head, kept.vector.tobytes(), kept.geometry or b""]
    body = _PARTS.pack(*map(len, parts)) + b"".join(parts)
    return _FILE.pack(_MAGIC, SCHEMA_VERSION, zlib.crc32(body)) + body


def read(data: bytes) -> Kept:
    """An answer from its bytes; ValueError and others where they are none."""
    magic, schema, checksum = _FILE.unpack_from(data)
    body = data[_FILE.size :]
    if magic != _MAGIC or schema != SCHEMA_VERSION or zlib.crc32(body) != checksum:
        raise ValueError("not an answer, or damaged")
    ends = np.cumsum([_PARTS.size, *_PARTS.unpack_from(body)]).tolist()
    head = json.loads(body[ends[0] : ends[1]])
    vector = np.frombuffer(body[ends[1] : ends[2]], np.uint8)
    return _of(head, vector, body[ends[2] : ends[3]] if head["geometry"] else None)


def read_head(beginning: bytes, more: Callable[[int], bytes]) -> Kept:
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


def _of(head: dict[str, Any], vector: Bytes, geometry: bytes | None) -> Kept:
    return Kept(
        answer=Answer.model_validate(head["answer"]),
        query=Query.model_validate(head["query"]),
        model_id=head["model_id"],
        vector=vector,
        geometry=geometry,
        ranked=tuple(head["ranked"]),
        at=head["at"],
        taken=Taken(**head["taken"]),
        base=None if head["base"] is None else (head["base"][0], np.array(head["base"][1])),
    )
