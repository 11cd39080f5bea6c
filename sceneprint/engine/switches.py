"""Queries that meet a map's switch to another model: answered wholly with one, or asked again."""

from __future__ import annotations

from collections.abc import Callable

from sceneprint.errors import Busy, ModelMismatch, SceneprintError, UnknownMap
from sceneprint.schemas import Answer
from sceneprint.store import Store
from sceneprint.store.maps import find_map
from sceneprint.store.records import MapRow

#: Times that a query is asked while its map switches from model to model.
TRIES = 5


def steadily(store: Store, map_name: str, ask: Callable[[MapRow], Answer]) -> Answer:
    """Ask a map, and once more where it switched to another model meanwhile.

    Parameters
    ----------
    store : see Store
    map_name : of the map
    ask : signs the query with the model of the row, and answers it from a map of that model

    Raises
    ------
    UnknownMap : no such map.
    Busy : the map switched again and again.
    """
    with store.database.read() as connection:
        row = find_map(connection, map_name)
    for _ in range(TRIES):
        try:
            found = ask(row)
        except SceneprintError:
            now = _other_model(store, row)
            if now is None:
                raise
        else:
            # also where all went well: artifacts of the former model may have been missed
            now = _other_model(store, row)
            if now is None:
                return found
        row = now
    raise Busy(f"Map {map_name!r} changed its model again and again while it was asked. Ask again.")


def check_model(one: str, other: str) -> None:
    """See that signatures are of one model before they are compared.

    Raises
    ------
    ModelMismatch : they are not.
    """
    if one != other:
        raise ModelMismatch(
            f"Signatures of two models cannot be compared: {one[:12]} and {other[:12]}. Ask again."
        )


def _other_model(store: Store, row: MapRow) -> MapRow | None:
    """The map where it has another model by now, or None."""
    try:
        with store.database.read() as connection:
            now = find_map(connection, row.name)
    except UnknownMap:
        return None
    return now if now.number == row.number and now.model_id != row.model_id else None
