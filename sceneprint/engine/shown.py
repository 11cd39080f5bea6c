"""Whether what was made of frames and maps still stands, or one of them was deleted since."""

from __future__ import annotations

import math

from sqlalchemy import select

from sceneprint.engine.kept import Kept
from sceneprint.schemas import FrameState
from sceneprint.store import Store
from sceneprint.store.tables import frames, maps


class Standing:
    """Looks frames and maps up, once each: of one moment, so make a new one for the next.

    Parameters
    ----------
    store : see Store
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._maps: dict[str, float | None] = {}  # when they were made, seconds since 1970
        self._frames: dict[tuple[str, str], float | None] = {}  # when they were received

    def asked(self, kept: Kept) -> bool:
        """Whether the maps that were asked are still those, and the frame that was looked up is
        there, or one that has its id since: whoever asks again is told of that.
        """
        frame = kept.answer.frame
        return all(self.map(name, kept.at) for name in kept.answer.maps) and (
            frame is None or self.frame(frame.map, frame.frame_id, math.inf)
        )

    def all_of(self, kept: Kept) -> bool:
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
                        frames.c.state != FrameState.DELETED,
                    )
                )
                self._frames.update({(name, frame_id): at for frame_id, at in found})
