"""How a map grew: frames by the hour or the day in which they were indexed."""

from __future__ import annotations

import time

from sceneprint.engine.wire import when
from sceneprint.schemas import FrameState
from sceneprint.schemas.growth import By, Grown, Growth
from sceneprint.store import Store
from sceneprint.store.growth import indexed_by_time
from sceneprint.store.maps import count_frames, find_map

WIDTHS_S: dict[By, float] = {"hour": 3600.0, "day": 86400.0}


def growth(store: Store, map_name: str, by: By = "day", last: int = 30) -> Growth:
    """How many of a map's frames were indexed in each of the last hours or days, of UTC.

    Parameters
    ----------
    store : see Store
    map_name : of the map
    by : what is counted by
    last : hours or days, with the one that is not over

    Raises
    ------
    UnknownMap : no such map.
    """
    width = WIDTHS_S[by]
    start = (time.time() // width - last + 1) * width
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        indexed = count_frames(connection, row.number).get(FrameState.INDEXED, 0)
        counts = indexed_by_time(connection, row.number, start, width)
    ahead = sum(n for place, n in counts.items() if place >= last)
    counts[last - 1] += ahead  # by a clock that was set back since
    total = before = indexed - sum(counts[place] for place in range(last))
    buckets: list[Grown] = []
    for place in range(last):
        total += counts[place]
        buckets.append(Grown(at=when(start + place * width), indexed=counts[place], total=total))
    return Growth(map=row.name, by=by, indexed=indexed, before=before, buckets=buckets)
