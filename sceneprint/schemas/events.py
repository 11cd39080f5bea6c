"""Events as JSON: what happened, in the order in which it happened."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import Field

from sceneprint.schemas.base import Page, Told

#: Every kind of event with what it means. A test holds the code to it.
KINDS = {
    "map.created": "A map was made.",
    "map.edited": "Its title or what else may change of it was changed.",
    "map.deleted": "A map was removed with all that was in it.",
    "map.reencoding": "A map is being signed with another model, `data.model`.",
    "map.reencoding_cancelled": "It was told to keep its model.",
    "map.reencoded": "It has switched from `data.before` to `data.model`.",
    "frame.received": "A frame is stored durably and waits for a worker, or is tried again.",
    "frame.indexed": "Queries find it from now on.",
    "frame.rejected": "Nothing in it can be signed.",
    "frame.redundant": "It was not kept, as asked: the map has its place.",
    "frame.failed": "Signing it broke down in every try, or was given up.",
    "frame.edited": "Its metadata was changed.",
    "frame.reencoded": "It was signed once more, for the model to come or what was damaged.",
    "frame.deleted": (
        "It was removed; no query finds it. `data.reason` is `retention` where its map keeps none "
        "so old."
    ),
    "import.done": "An archive was imported, as far as it could be; `data` is its result.",
    "association.found": "A job that looked for associations is over; `data` is its result.",
    "key.created": "A key was made; of no map.",
    "key.revoked": "A key opens nothing any more; of no map.",
}
#: Stands in a stream where events are not there any more; kept by nobody.
MISSED = "events.missed"


class Event(Told):
    """Something that happened."""

    id: str = Field(
        description="Of no meaning but to be given back: as `Last-Event-ID` to a stream, as "
        "`after` to a request. Ids have no order; events are told in theirs."
    )
    at: datetime
    kind: str = Field(
        description="Such as frame.indexed; docs/operations.md lists all. A client may meet "
        "kinds that it does not know yet. `events.missed` stands where events that were asked for "
        "are no longer kept: look at the maps themselves, then go on."
    )
    map: str | None = Field(description="Name of the map that it is about.")
    frame_id: str | None
    job_id: str | None
    data: dict[str, Any] = Field(description="More, by kind.")


class EventPage(Page[Event]):
    """A part of the events that are kept."""

    newest: str = Field(
        description="Id of the newest event of your maps, of whatever kind, when this was asked; "
        "0 where there was none yet: what follows it is told by a stream with this as `after`."
    )
