"""Making maps."""

from __future__ import annotations

from sceneprint.engine.wire import tell_map
from sceneprint.errors import MapExists
from sceneprint.models import read_model, write_model
from sceneprint.schemas import Map, NewMap
from sceneprint.store import Store
from sceneprint.store.maps import add_map, keep_model, list_maps

#: Fields of a new map that say what it may hold, and for how long.
LIMITS = frozenset(("quota_frames", "quota_bytes", "retention_days"))


def create_map(store: Store, new: NewMap) -> tuple[Map, bool]:
    """Make a map, or find that it is there as wanted.

    Returns
    -------
    made : the map
    new : False where it was there

    Raises
    ------
    MapExists : there is one of that name with another title, model, quota or retention.
    """
    model = read_model(new.model)
    limits = new.model_dump(include=set(LIMITS & new.model_fields_set))
    with store.database.write() as connection:
        there = {row.name: row for row in list_maps(connection)}.get(new.name)
        if there is None:
            keep_model(connection, model.id, model.name, write_model(model))
            row = add_map(connection, new.name, new.title, model.id, limits)
            return tell_map(connection, row), True
        other = any(getattr(there, name) != value for name, value in limits.items())
        if other or (there.title, there.model_id) != (new.title, model.id):
            raise MapExists(
                f"There is a map {new.name!r} with another title or model, or other limits. "
                "Use it as it is, delete it, or choose another name."
            )
        return tell_map(connection, there), False
