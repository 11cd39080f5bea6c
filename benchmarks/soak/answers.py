"""What a data folder holds and answers, in words that do not depend on who was first.

Frames have other ids and numbers in every run; their content has not.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, func, select

from benchmarks.soak.load import MAP
from sceneprint.engine import Engine
from sceneprint.settings import Settings
from sceneprint.store.tables import audit, events, frames, jobs, maps, signatures
from sceneprint_client import Client
from sceneprint_client.api import Answer

#: Kinds of events of what clients change.
CHANGES = ("map.created", "frame.received", "frame.deleted")
#: Frames that are looked up: so many of them for their ranking, so many validated too.
RANKED, VALIDATED = 40, 8


@dataclass(frozen=True)
class State:
    """A map as it is in the end.

    Parameters
    ----------
    contents : of the indexed frames by their ids
    signatures : by content
    doubled : frames beyond one of a content, and signatures beyond one of a frame
    tries : most tries of a job
    separated : changes with an event but no line of the audit log, or the other way round
    answers : of queries with exact=true, by the content that was asked for
    """

    contents: dict[str, str]
    signatures: dict[str, bytes]
    doubled: int
    tries: int
    separated: int
    answers: dict[str, Any]


def state_of(data: Path, url: str | None) -> State:
    """Read a data folder, and ask its service, or the folder itself where there is none."""
    with Engine(Settings(data_dir=data)) as engine, engine.store.database.read() as connection:
        rows = connection.execute(
            select(frames.c.id, frames.c.content_id, signatures.c.vector)
            .join(signatures, signatures.c.frame_number == frames.c.number)
            .join(maps, maps.c.number == frames.c.map_number)
            .where(frames.c.state == "indexed", maps.c.name == MAP)
            .order_by(frames.c.content_id)
        ).all()
        tries = int(connection.execute(select(func.max(jobs.c.attempts))).scalar_one())
        separated = _separated(connection)
    contents = {row.id: row.content_id for row in rows}
    client = Client.embedded(data) if url is None else Client(url)
    with client:
        names = sorted(contents, key=contents.__getitem__)
        ranked = names[:: max(len(names) // RANKED, 1)]
        validated = names[:: max(len(names) // VALIDATED, 1)]
        answers = {
            f"{contents[name]} ranked": _told(
                client.query(MAP, frame_id=name, exact=True, stages=("retrieve",), k=20), contents
            )
            for name in ranked
        } | {
            f"{contents[name]} validated": _told(
                client.query(MAP, frame_id=name, exact=True, k=3), contents
            )
            for name in validated
        }
    return State(
        contents=contents,
        signatures={row.content_id: bytes(row.vector) for row in rows},
        doubled=2 * len(rows) - len(contents) - len(set(contents.values())),
        tries=tries,
        separated=separated,
        answers=answers,
    )


def _separated(connection: Connection) -> int:
    """Count the changes of clients to the map whose event or line of the audit log is missing."""
    by_event, by_line = (
        Counter(
            tuple(row)
            for row in connection.execute(
                select(kind, name, target).where(name == MAP, kind.in_(CHANGES))
            )
        )
        for kind, name, target in (
            (events.c.kind, events.c.map, events.c.frame_id),
            (audit.c.action, audit.c.map, audit.c.target),
        )
    )
    return (by_event - by_line).total() + (by_line - by_event).total()


def _told(answer: Answer, contents: dict[str, str]) -> dict[str, Any]:
    """An answer without ids, times and generations; equal distances in the order of contents."""
    matches = [
        {
            "content": contents[one.frame_id], "distance": one.distance,
            "validation": one.validation.model_dump(),
            "transform": None if one.transform is None else [
                one.transform.translation.model_dump(), one.transform.rotation.model_dump()
            ],
        }
        for one in answer.matches
    ]  # fmt: skip
    return {
        "status": answer.status,
        "counts": answer.counts.model_dump(),
        "matches": sorted(matches, key=lambda one: (one["distance"], one["content"])),
    }
