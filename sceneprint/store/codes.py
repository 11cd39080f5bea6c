"""Compact codes of signatures in PostgreSQL, by which pgvector proposes candidates: a cache.

signature  --index.codes-->  code  --put_codes-->  codes_<fit>  --graphs.nearest-->  frames
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from sqlalchemy import Connection, text

from sceneprint.store.fits import Fit, list_fits
from sceneprint.types import Floats32

#: What 16 bits hold, and a little less.
_LARGEST = 60_000.0


# codes


def as_text(code: Floats32) -> str:
    """A code as PostgreSQL reads it."""
    return "[" + ",".join(f"{x:.5g}" for x in np.clip(code, -_LARGEST, _LARGEST).tolist()) + "]"


def put_codes(
    connection: Connection, fit: Fit, codes: Mapping[int, Floats32], *, anew: bool = False
) -> None:
    """Keep codes of frames by their numbers, of those that are indexed.

    Each frame is held until the commit, so that none that is being deleted gets one.

    Parameters
    ----------
    connection : of a writing transaction, in its turn or not
    fit : that made them
    codes : (d,) each
    anew : in place of those that are there, of signatures that were made again
    """
    change = "UPDATE SET code = EXCLUDED.code" if anew else "NOTHING"
    if codes:
        connection.execute(
            text(
                f"INSERT INTO {fit.table} (frame_number, map_number, code) "
                "SELECT number, map_number, CAST(:code AS halfvec) FROM frames "
                "WHERE number = :n AND state = 'indexed' FOR SHARE "
                f"ON CONFLICT (frame_number) DO {change}"
            ),
            [{"n": number, "code": as_text(codes[number])} for number in sorted(codes)],
        )


def forget_codes(connection: Connection, numbers: Collection[int]) -> None:
    """Remove the codes of frames, in the transaction that deletes these, after it has done so."""
    for fit in list_fits(connection) if numbers else ():
        connection.execute(
            text(f"DELETE FROM {fit.table} WHERE frame_number = ANY(CAST(:numbers AS bigint[]))"),
            {"numbers": list(numbers)},
        )


def forget_map(connection: Connection, map_number: int) -> None:
    """Remove the codes of all frames of a map, in the transaction that removes it."""
    for fit in list_fits(connection):
        for table in (fit.table, "code_maps"):
            connection.execute(
                text(f"DELETE FROM {table} WHERE map_number = :map"), {"map": map_number}
            )


def count_codes(connection: Connection, fit: Fit) -> int:
    """How many frames have a code."""
    return int(connection.execute(text(f"SELECT count(*) FROM {fit.table}")).scalar_one())


def sweep(connection: Connection, fit: Fit) -> int:
    """Remove codes of frames that are not found any more; returns how many."""
    gone = connection.execute(
        text(
            f"DELETE FROM {fit.table} c WHERE NOT EXISTS "
            "(SELECT 1 FROM frames f WHERE f.number = c.frame_number AND f.state = 'indexed')"
        )
    )
    return int(gone.rowcount)


# which frames have one


def uncoded(
    connection: Connection, fit: Fit, map_numbers: Sequence[int], limit: int
) -> dict[int, int]:
    """Some indexed frames of maps that have no code: their numbers, and those of their maps."""
    found = connection.execute(
        text(
            # map by map, by its index over revisions: the planner is not asked to find that out
            "SELECT f.number, f.map_number FROM unnest(CAST(:maps AS bigint[])) AS m (number) "
            "CROSS JOIN LATERAL (SELECT number, map_number FROM frames "
            "WHERE map_number = m.number AND state = 'indexed' AND revision > COALESCE((SELECT "
            "revision FROM code_maps WHERE fit_number = :fit AND map_number = m.number), 0) "
            f"AND NOT EXISTS (SELECT 1 FROM {fit.table} c WHERE c.frame_number = frames.number) "
            "LIMIT :most) f LIMIT :most"
        ),
        {"fit": fit.number, "maps": list(map_numbers), "most": limit},
    )
    return {row[0]: row[1] for row in found}


def without_code(
    connection: Connection, fit: Fit, map_numbers: Sequence[int], after: int, limit: int
) -> list[int]:
    """The next indexed frames of maps that have a signature, and no code; by number."""
    found = connection.execute(
        text(
            "SELECT f.number FROM frames f "
            "JOIN signatures s ON s.frame_number = f.number AND s.model_id = :model "
            f"LEFT JOIN {fit.table} c ON c.frame_number = f.number "
            "WHERE f.number > :after AND f.state = 'indexed' AND c.frame_number IS NULL "
            "AND f.map_number = ANY(CAST(:maps AS bigint[])) ORDER BY f.number LIMIT :most"
        ),
        {"model": fit.model_id, "after": after, "maps": list(map_numbers), "most": limit},
    )
    return list(found.scalars())


def forget_complete(connection: Connection, fit: Fit) -> None:
    """Have all frames looked at again: which of them have no code."""
    connection.execute(text("DELETE FROM code_maps WHERE fit_number = :fit"), {"fit": fit.number})


def set_complete(connection: Connection, fit: Fit, map_number: int, revision: int) -> None:
    """Note that all frames of a map have their code that were indexed up to a revision."""
    connection.execute(
        text(
            "INSERT INTO code_maps (fit_number, map_number, revision) "
            "SELECT number, :map, :revision FROM code_fits WHERE number = :fit "
            "ON CONFLICT (fit_number, map_number) DO UPDATE SET revision = EXCLUDED.revision"
        ),
        {"fit": fit.number, "map": map_number, "revision": revision},
    )


def complete_up_to(connection: Connection, fit: Fit) -> dict[int, int]:
    """Revisions up to which maps have all codes, by their numbers."""
    found = connection.execute(
        text("SELECT map_number, revision FROM code_maps WHERE fit_number = :fit"),
        {"fit": fit.number},
    )
    return {row[0]: row[1] for row in found}
