"""What a frame was uploaded on condition of: that its map lacks the place."""

from __future__ import annotations

from sqlalchemy import ColumnElement, Connection, update

from sceneprint.schemas import FrameState
from sceneprint.store.tables import frames


def loosen(connection: Connection, number: int, novelty: float | None) -> None:
    """Keep a frame that is not signed yet on the weaker of two conditions.

    Who sends it with a weaker one, or with none, is told that it is there.
    """
    weaker: ColumnElement[bool] = frames.c.novelty.is_not(None)
    if novelty is not None:
        weaker = frames.c.novelty > novelty
    connection.execute(
        update(frames)
        .where(
            frames.c.number == number,
            frames.c.state.in_((FrameState.RECEIVED, FrameState.SIGNING)),
            weaker,
        )
        .values(novelty=novelty)
    )
