"""The header Idempotency-Key: a request that is sent again takes effect once.

guarded(asking, key, route, payload...)  -->  Once, which the engine stores with what it made
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated

from fastapi import Header, Response
from pydantic import BaseModel

from sceneprint.store.idempotency import Once
from service.access import Caller

#: As a parameter of a route: `key: IdempotencyKey = None`.
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=255,
        pattern=r"^[\x20-\x7e]+$",
        description="Made up by the caller for this request, printable ASCII. The same request "
        "sent again with it within a day takes effect once, and is answered as things are now, "
        "with `Idempotent-Replayed: true`; another request with it is refused.",
    ),
]


def guarded(asking: Caller, key: str | None, *parts: object) -> Once | None:
    """What makes a request take effect once; None where the caller asks for no such thing.

    Parameters
    ----------
    asking : who asks: keys of two callers have nothing to do with each other
    key : of the header
    parts : of the request, all that makes it another one: route, map, content, metadata; bytes,
        records, or what JSON can say
    """
    if key is None:
        return None
    return Once(asking.name, key, _fingerprint(parts))


def tell_replayed(response: Response, *, replayed: bool) -> None:
    """Say that an answer is that of an earlier request."""
    if replayed:
        response.headers["Idempotent-Replayed"] = "true"


def _fingerprint(parts: tuple[object, ...]) -> str:
    plain = [_plain(part) for part in parts]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _plain(part: object) -> object:
    if isinstance(part, bytes):
        return hashlib.sha256(part).hexdigest()
    if isinstance(part, BaseModel):
        # a field that a later version adds must not make a request of before another one
        return part.model_dump(mode="json", exclude_defaults=True)
    if isinstance(part, list | tuple):
        return [_plain(one) for one in part]
    return part
