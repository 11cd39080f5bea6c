"""What a request asks of a representation: its type, and whether it is still the one it knows.

Headers Accept, If-Match, If-None-Match (RFC 9110, sections 12.5.1, 13.1).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

from fastapi import Request

from sceneprint.errors import InvalidRequest

_TAG = re.compile(r'(W/)?"([\x21\x23-\x7e\x80-\xff]*)"')
_TYPE = re.compile(r"\s*([\w.+*-]+/[\w.+*-]+)\s*((?:;[^,]*)?)", re.ASCII)
_QUALITY = re.compile(r";\s*q\s*=\s*(\d+(?:\.\d*)?)", re.ASCII)


def expected(request: Request) -> Collection[str] | None:
    """Entity tags of If-Match, one of which the resource must have; None for any.

    Raises
    ------
    InvalidRequest : a header that holds no tag.
    """
    header = ", ".join(request.headers.getlist("if-match")).strip()
    if header in ("", "*"):
        return None
    found = _TAG.findall(header)
    if not found:
        raise InvalidRequest(
            f"The header If-Match is {header!r:.80}. Send the ETag that came with what is to be "
            "edited, with its quotes.",
            (("If-Match", "no entity tag"),),
        )
    return frozenset(tag for weak, tag in found if not weak)


def is_known(request: Request, tag: str) -> bool:
    """Whether If-None-Match says that the caller has what this tag stands for."""
    header = ", ".join(request.headers.getlist("if-none-match")).strip()
    return header == "*" or any(one == tag for _, one in _TAG.findall(header))


def chosen(request: Request, offers: Sequence[str]) -> str:
    """The media type that Accept likes best; the first where it likes none, or has no say."""
    ranges = []
    for kind, parameters in _TYPE.findall(", ".join(request.headers.getlist("accept"))[:1000]):
        quality = _QUALITY.search(parameters)
        ranges.append((kind.lower(), min(float(quality[1]), 1.0) if quality else 1.0))
    rated = [max((_rated(offer, one) for one in ranges), default=(0, 0.0)) for offer in offers]
    best = max(quality for _, quality in rated)
    return offers[[quality for _, quality in rated].index(best)]


def _rated(offer: str, one: tuple[str, float]) -> tuple[int, float]:
    """How closely a range of Accept speaks of a type, and how much it likes it."""
    kind, quality = one
    if kind == offer:
        return 3, quality
    if kind == f"{offer.partition('/')[0]}/*":
        return 2, quality
    return (1, quality) if kind == "*/*" else (0, 0.0)
