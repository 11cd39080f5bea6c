"""Which maps of a query are searched in the database, and not on this node.

A node that holds an index of a map, or can read the little that it lacks, searches it itself; of
the others it asks pgvector. So one that has just begun answers at once.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.remembered import Remembered
from sceneprint.engine.shortlists import WHOLE
from sceneprint.engine.stored import Stored
from sceneprint.index import Code, read_code
from sceneprint.store import Database, codes, fits, vectors
from sceneprint.store.fits import Fit
from sceneprint.store.records import MapRow
from sceneprint.types import Floats32

Setting = Literal["auto", "local", "database"]

#: Times as long as counting the frames of a map took, until they are counted again.
_COUNTED = 20
#: Codes that are held, of some 13 MB each: one of each model in use, and its successor.
_CODES = 4


@dataclass(frozen=True)
class _Counted:
    revision: int
    size: int
    until: float


class Choosing:
    """What of the database this process holds to search in it.

    Parameters
    ----------
    setting : `local` never asks the database; `database` wherever it can; `auto` where an index is
        missing here
    purge_s : seconds after which nothing is held of a deleted frame
    """

    def __init__(self, setting: Setting = "auto", purge_s: float = 3600.0) -> None:
        self.setting: Setting = setting
        self.remembered = Remembered(purge_s)
        self._lock = threading.Lock()
        self._codes: OrderedDict[str, Code] = OrderedDict()
        self._sizes: dict[int, _Counted] = {}

    def is_possible(self, connection: Connection) -> bool:
        """Whether any map may be searched in the database."""
        return self.setting != "local" and fits.can_have(connection)

    def has_codes(self, connection: Connection) -> bool:
        """Whether the codes of a model are there to be asked."""
        known = fits.list_fits(connection) if self.is_possible(connection) else []
        return any(fit.state == "live" for fit in known)

    def stored(
        self, connection: Connection, database: Database, rows: Sequence[MapRow], length: int
    ) -> dict[int, Stored]:
        """Maps of one model as the database has them, by number: those whose codes are there.

        Parameters
        ----------
        connection : a reading transaction of `database`
        database : to search in
        rows : of the maps
        length : bytes of a signature
        """
        fit = fits.live_fit(connection, rows[0].model_id) if rows else None
        if fit is None:
            return {}
        numbers = [row.number for row in rows]
        if len(codes.uncoded(connection, fit, numbers, WHOLE + 1)) > WHOLE:
            numbers = [
                number for number in numbers
                if len(codes.uncoded(connection, fit, [number], WHOLE + 1)) <= WHOLE // len(rows)
            ]  # fmt: skip
        sizes = self._count(connection, [row for row in rows if row.number in numbers])
        return {
            row.number: Stored(
                database, self.code_of, self.remembered, row.number, row.model_id, row.revision,
                sizes[row.number], length,
            )
            for row in rows
            if row.number in sizes
        }  # fmt: skip

    def code_of(self, connection: Connection, fit: Fit) -> Code:
        """The code of a fit, which was just read in this transaction."""
        with self._lock:
            held = self._codes.get(fit.code_id)
        if held is None:
            held = read_code(fits.content_of(connection, fit))
        with self._lock:
            self._codes[fit.code_id] = held
            self._codes.move_to_end(fit.code_id)
            while len(self._codes) > _CODES:
                self._codes.popitem(last=False)
        return held

    def coded(
        self, database: Database, model_id: str, vector: bytes
    ) -> tuple[Fit, Floats32] | None:
        """The code of a signature that is about to be stored; None where none is kept."""
        if self.setting == "local" or database.is_sqlite:
            return None
        with database.read() as connection:
            fit = fits.live_fit(connection, model_id)
            if fit is None:
                return None
            code = self.code_of(connection, fit)
        return fit, code.encode(np.frombuffer(vector, np.uint8)[None])[0]

    def keep(
        self, connection: Connection, number: int, coded: tuple[Fit, Floats32] | None, *,
        anew: bool = False,
    ) -> None:  # fmt: skip
        """Keep the code of a frame in the transaction that stores its signature.

        Where another fit is asked by now it is left to the upkeep, and the frame compared exactly
        until then; so is one whose signature was made again (`anew`) and has no code.
        """
        if coded is None:
            if anew:
                codes.forget_codes(connection, [number])
            return
        fit, code = coded
        now = fits.live_fit(connection, fit.model_id)
        if now is not None and now.number == fit.number:
            codes.put_codes(connection, fit, {number: code}, anew=anew)

    def _count(self, connection: Connection, rows: Sequence[MapRow]) -> dict[int, int]:
        """Frames of maps; of one that changes all the time, as of a moment ago."""
        now = time.monotonic()
        found, changed = {}, []
        for row in rows:
            held = self._sizes.get(row.number)
            if held is not None and (held.revision == row.revision or now < held.until):
                found[row.number] = held.size
            else:
                changed.append(row)
        if changed:
            counted = vectors.sizes(connection, [row.number for row in changed])
            until = time.monotonic() + _COUNTED * (time.monotonic() - now)
            for row in changed:
                found[row.number] = counted[row.number]
                self._sizes[row.number] = _Counted(row.revision, counted[row.number], until)
        return found

    def forget(self, map_number: int) -> None:
        """Give up what is known of a map that is gone."""
        self._sizes.pop(map_number, None)
