"""A stream of events over HTTP, read for as long as anybody wants it.

lines  --messages-->  events, each with the id to go on from  --followed-->  events for ever
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sceneprint.schemas.events import Event

if TYPE_CHECKING:
    import httpx

#: Seconds of silence after which a stream is taken to be dead: it says three times that it lives.
SILENCE_S = 50.0
#: Seconds before a stream that ended is asked for again, unless it said otherwise.
PAUSE_S = 1.0


@dataclass
class Place:
    """How far a stream has been read.

    Parameters
    ----------
    last : `id` that came last; None: there was none
    pause_s : to wait before the stream is asked for again
    """

    last: str | None
    pause_s: float = PAUSE_S


def messages(lines: Iterable[str], place: Place) -> Iterator[Event]:
    """Events of a stream; the place is moved on before each is given out."""
    data: list[str] = []
    last = place.last
    for line in lines:
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if not line:
            place.last = last
            if data:
                yield Event.model_validate_json("\n".join(data))
            data = []
        elif name == "data":
            data.append(value)
        elif name == "id" and "\0" not in value:
            last = value
        elif name == "retry" and value.isascii() and value.isdigit():
            place.pause_s = min(float(value[:9]) / 1e3, SILENCE_S)


def followed(opened: Callable[[str | None], httpx.Response], after: str | None) -> Iterator[Event]:
    """Events of one stream after the other, as if it were one.

    Parameters
    ----------
    opened : asks for a stream, from an `id` on; raises where there will be none
    after : id of the event to begin behind; None: from now on
    """
    import httpx

    from sceneprint.errors import Unreachable

    place = Place(after)
    met = False
    while True:
        try:
            with closing(opened(place.last)) as response:
                met = True
                yield from messages(response.iter_lines(), place)
        except httpx.TransportError:
            pass  # it broke, or was silent for too long
        except Unreachable:
            if not met:
                raise
        time.sleep(place.pause_s)
