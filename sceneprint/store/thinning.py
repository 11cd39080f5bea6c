"""What frames of a map weigh, and which a session brought: for whoever thins it out."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, select

from sceneprint.schemas import FrameState
from sceneprint.store.records import MapRow
from sceneprint.store.tables import frames, signatures


@dataclass(frozen=True)
class Weight:
    """A frame that is indexed.

    Parameters
    ----------
    frame_id : of the frame
    upload_bytes : of its upload
    artifact : blob of its geometry
    """

    frame_id: str
    upload_bytes: int
    artifact: str


def weights_of(
    connection: Connection, row: MapRow, session: str | None = None
) -> dict[int, Weight]:
    """Indexed frames of a map by their numbers, in the order they came.

    Parameters
    ----------
    connection : of a transaction
    row : of the map
    session : only frames of this one, where given
    """
    asked = (
        select(frames.c.number, frames.c.id, frames.c.bytes, signatures.c.geometry)
        .join(
            signatures,
            (signatures.c.frame_number == frames.c.number)
            & (signatures.c.model_id == row.model_id),
        )
        .where(frames.c.map_number == row.number, frames.c.state == FrameState.INDEXED)
        .order_by(frames.c.number)
    )
    if session is not None:
        asked = asked.where(frames.c.session == session)
    found = connection.execute(asked)
    return {number: Weight(*rest) for number, *rest in found}
