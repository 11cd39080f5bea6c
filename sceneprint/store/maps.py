"""Maps and the models they are signed with."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

from sqlalchemy import Connection, delete, func, insert, select, update

from sceneprint.errors import UnknownMap
from sceneprint.store.deletion import doom_found
from sceneprint.store.events import record_event
from sceneprint.store.quotas import inherited, remember
from sceneprint.store.tables import (
    MapRow,
    frame_tags,
    frames,
    job_files,
    job_items,
    jobs,
    map_row,
    maps,
    models,
    signatures,
)


def find_map(connection: Connection, name: str) -> MapRow:
    """The map of a name.

    Raises
    ------
    UnknownMap : there is none.
    """
    row = connection.execute(select(maps).where(maps.c.name == name)).mappings().first()
    if row is None:
        raise unknown_map(name)
    return map_row(row)


def find_maps(connection: Connection, names: Sequence[str]) -> list[MapRow]:
    """The maps of some names, in their order, by one statement; UnknownMap where one is none."""
    if len(names) == 1:
        return [find_map(connection, names[0])]
    found = connection.execute(select(maps).where(maps.c.name.in_(names))).mappings()
    rows = {row["name"]: map_row(row) for row in found}
    for name in names:
        if name not in rows:
            raise unknown_map(name)
    return [rows[name] for name in names]


def unknown_map(name: str) -> UnknownMap:
    """What is said of a map that is not there, or not for whoever asks: the same words."""
    return UnknownMap(
        f"There is no map {name!r:.80}. List the maps with `sceneprint maps` or GET /v1/maps, "
        "or make it."
    )


def map_of(connection: Connection, number: int) -> MapRow:
    """The map of a number that is known to exist."""
    return map_row(connection.execute(select(maps).where(maps.c.number == number)).mappings().one())


def list_maps(connection: Connection) -> list[MapRow]:
    """All maps by name."""
    return [
        map_row(row) for row in connection.execute(select(maps).order_by(maps.c.name)).mappings()
    ]


def add_map(
    connection: Connection, name: str, title: str | None, model_id: str,
    limits: Mapping[str, float | None] | None = None,
) -> MapRow:  # fmt: skip
    """Make a map; its name must be free.

    Parameters
    ----------
    connection : of a writing transaction
    name, title, model_id : of the map
    limits : `quota_frames`, `quota_bytes`, `retention_days`, where they are given; quotas that are
        not are those of the map that had this name before: whoever may delete a map and make it
        anew does not get rid of its quota
    """
    connection.execute(
        insert(maps).values(
            name=name, title=title, model_id=model_id, revision=0, created_at=time.time(),
            **(inherited(connection, name) | dict(limits or {})),
        )
    )  # fmt: skip
    record_event(connection, "map.created", name)
    return find_map(connection, name)


def next_revision(connection: Connection, map_number: int) -> int:
    """Count one change of what is searched; commits of one map follow each other in this order."""
    connection.execute(
        update(maps).where(maps.c.number == map_number).values(revision=maps.c.revision + 1)
    )
    return int(
        connection.execute(select(maps.c.revision).where(maps.c.number == map_number)).scalar_one()
    )


def count_frames(connection: Connection, map_number: int) -> dict[str, int]:
    """How many frames are in each state that has any."""
    rows = connection.execute(
        select(frames.c.state, func.count())
        .where(frames.c.map_number == map_number)
        .group_by(frames.c.state)
        .order_by(frames.c.state)
    )
    return {row[0]: row[1] for row in rows}


def remove_map(connection: Connection, row: MapRow) -> list[str]:
    """Remove a map with all that is in it.

    Returns
    -------
    blobs : that it referred to
    """
    own = select(frames.c.number).where(frames.c.map_number == row.number)
    of_map = select(jobs.c.number).where(jobs.c.map_number == row.number)
    asked = (
        select(frames.c.blob).where(frames.c.map_number == row.number),
        select(signatures.c.geometry).where(signatures.c.frame_number.in_(own)),
        select(job_files.c.blob).where(job_files.c.job_number.in_(of_map)),
    )
    referred = sorted({blob for one in asked for blob in connection.execute(one).scalars()})
    doom_found(connection, *asked)
    connection.execute(delete(signatures).where(signatures.c.frame_number.in_(own)))
    for made in (job_items, job_files):
        connection.execute(delete(made).where(made.c.job_number.in_(of_map)))
    connection.execute(delete(jobs).where(jobs.c.map_number == row.number))
    connection.execute(delete(frame_tags).where(frame_tags.c.frame_number.in_(own)))
    connection.execute(delete(frames).where(frames.c.map_number == row.number))
    connection.execute(delete(maps).where(maps.c.number == row.number))
    record_event(connection, "map.deleted", row.name)
    remember(connection, row)
    return referred


def keep_model(connection: Connection, model_id: str, name: str, content: bytes) -> None:
    """Keep a model's file, where it is not kept yet."""
    if connection.execute(select(models.c.id).where(models.c.id == model_id)).first() is None:
        connection.execute(
            insert(models).values(
                id=model_id, name=name[:64], content=content, created_at=time.time()
            )
        )


def model_content(connection: Connection, model_id: str) -> bytes:
    """The file of a model that a map refers to."""
    return bytes(
        connection.execute(select(models.c.content).where(models.c.id == model_id)).scalar_one()
    )


def model_names(connection: Connection) -> dict[str, str]:
    """Names of all models by their id."""
    return {row.id: row.name for row in connection.execute(select(models.c.id, models.c.name))}
