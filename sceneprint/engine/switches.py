"""Queries that meet a map's switch to another model: answered wholly with one, or asked again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from sceneprint.errors import Busy, ModelMismatch, SceneprintError, UnknownMap
from sceneprint.store import Store
from sceneprint.store.maps import find_maps
from sceneprint.store.records import MapRow

T = TypeVar("T")

#: Times that a query is asked while its map switches from model to model.
TRIES = 5


def steadily(store: Store, maps: Sequence[str], ask: Callable[[list[MapRow]], T]) -> T:
    """Ask maps, and once more where one of them switched to another model meanwhile.

    Parameters
    ----------
    store : see Store
    maps : their names
    ask : signs the query with the model of the rows, and answers it from maps of that model

    Raises
    ------
    UnknownMap : one of them is none.
    Busy : a map switched again and again.
    """
    with store.queried.read() as connection:
        rows = find_maps(connection, maps)
    for _ in range(TRIES):
        try:
            found = ask(rows)
        except SceneprintError:
            now = _other_models(store, rows)
            if now is None:
                raise
        else:
            # also where all went well: artifacts of the former model may have been missed
            now = _other_models(store, rows)
            if now is None:
                return found
        rows = now
    raise Busy(
        f"Map {', '.join(map(repr, maps))} changed its model again and again while it was asked. "
        "Ask again."
    )


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


def _other_models(store: Store, rows: Sequence[MapRow]) -> list[MapRow] | None:
    """The maps where one of them has another model by now, or None."""
    try:
        with store.queried.read() as connection:
            now = find_maps(connection, [row.name for row in rows])
    except UnknownMap:
        return None
    pairs = list(zip(now, rows, strict=True))
    if any(one.number != row.number for one, row in pairs):
        return None
    return now if any(one.model_id != row.model_id for one, row in pairs) else None
