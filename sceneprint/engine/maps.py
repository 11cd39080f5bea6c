"""Making maps."""

from __future__ import annotations

from sceneprint.engine.wire import tell_map
from sceneprint.errors import MapExists
from sceneprint.models import read_model, write_model
from sceneprint.schemas import Map, NewMap
from sceneprint.store import Store
from sceneprint.store.maps import add_map, keep_model, list_maps


def create_map(store: Store, new: NewMap) -> tuple[Map, bool]:
    """Make a map, or find that it is there as wanted.

    Returns
    -------
    made : the map
    new : False where it was there

    Raises
    ------
    MapExists : there is one of that name with another title or model.
    """
    model = read_model(new.model)
    with store.database.write() as connection:
        there = {row.name: row for row in list_maps(connection)}.get(new.name)
        if there is None:
            keep_model(connection, model.id, model.name, write_model(model))
            row = add_map(connection, new.name, new.title, model.id)
            return tell_map(connection, row), True
        if (there.title, there.model_id) != (new.title, model.id):
            raise MapExists(
                f"There is a map {new.name!r} with another title or model. "
                "Use it as it is, delete it, or choose another name."
            )
        return tell_map(connection, there), False
