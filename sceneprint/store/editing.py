"""Metadata written anew, with all that is searched for beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, delete, insert, update

from sceneprint.store.events import tell
from sceneprint.store.frames import frame_of
from sceneprint.store.maps import find_map
from sceneprint.store.records import FrameRow, MapRow
from sceneprint.store.tables import frame_tags, frames, maps


def write_frame(
    connection: Connection, row: MapRow, frame: FrameRow, values: Mapping[str, Any]
) -> FrameRow:
    """Change columns of a frame's metadata.

    Parameters
    ----------
    connection : of a writing transaction
    row : of the map
    frame : as it is
    values : by column; position and tags that are searched for follow `pose` and `tags`
    """
    changed = {name: new for name, new in values.items() if getattr(frame, name) != new}
    if not changed:
        return frame
    written = dict(changed)
    if "pose" in changed:
        pose = changed["pose"]
        written |= {f"pose_{a}": pose and pose[i][3] for i, a in enumerate("xyz")}
    connection.execute(update(frames).where(frames.c.number == frame.number).values(**written))
    if "tags" in changed:
        connection.execute(delete(frame_tags).where(frame_tags.c.frame_number == frame.number))
        named = [{"frame_number": frame.number, "tag": tag} for tag in sorted(set(changed["tags"]))]
        if named:
            connection.execute(insert(frame_tags), named)
    tell(connection, "frame.edited", row.name, frame.id, fields=sorted(changed))
    return frame_of(connection, frame.number)


def write_map(connection: Connection, row: MapRow, values: Mapping[str, Any]) -> MapRow:
    """Change columns of a map: title, quotas, retention."""
    changed = {name: new for name, new in values.items() if getattr(row, name) != new}
    if not changed:
        return row
    connection.execute(update(maps).where(maps.c.number == row.number).values(**changed))
    # not what they are: who may read the map sees it there
    tell(connection, "map.edited", row.name, fields=sorted(changed))
    return find_map(connection, row.name)
