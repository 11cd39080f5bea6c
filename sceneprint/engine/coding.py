"""Codes of all maps in the database, fitted and filled by workers beside everything else.

an even sample of all maps  --fit-->  code  --fill, block by block-->  a table  --make_live-->

One worker at a time does it, a little in each turn. A fit that frames have outgrown is replaced
by one beside it; queries ask the one or the other, and compare exactly what has no code yet.
"""

from __future__ import annotations

import logging
import time
import zlib
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from sceneprint.engine.choosing import Choosing
from sceneprint.engine.shortlists import WHOLE
from sceneprint.errors import SceneprintError, StoreLocked
from sceneprint.index import SHORTLIST, draw, fit_code, write_code
from sceneprint.index.codes import SAMPLE
from sceneprint.index.publishing import GROWTH
from sceneprint.store import Database, codes, fits, graphs, vectors
from sceneprint.store.fits import Fit
from sceneprint.store.maps import list_maps
from sceneprint.store.postgres import allow
from sceneprint.store.records import MapRow
from sceneprint.store.reencoding import models_of
from sceneprint.types import Bytes, Floats32

log = logging.getLogger(__name__)

#: Seconds for which a worker fills codes, before it looks for frames to sign again.
STEP_S = 2.0
#: Frames whose codes are one commit.
BLOCK = 256
#: Seconds between two comparisons of how many codes and how many frames there are.
CHECK_S = 600.0
#: Seconds until it is tried again where the database has no pgvector.
AGAIN_S = 600.0
#: Seconds until it is tried again where anything else went wrong.
PAUSE_S = 30.0
#: Seconds between two counts of all frames, to see whether they have outgrown the fit.
COUNT_S = 30.0


@dataclass
class _Filling:
    """How far a table is filled: a pass over all frames in the order of their numbers."""

    after: int = -1
    revisions: dict[int, int] = field(default_factory=dict)  # of the maps, when the pass began
    last: bool = False  # the pass after all are linked: what came meanwhile


class Coding:
    """Keeps the codes in the database near the signatures.

    Parameters
    ----------
    database : that holds both
    choosing : of this process
    """

    def __init__(self, database: Database, choosing: Choosing) -> None:
        self._database, self._choosing = database, choosing
        self._filling: dict[int, _Filling] = {}
        self._checked: dict[int, float] = {}  # by fit
        self._counted: dict[str, tuple[float, int]] = {}  # by model
        self._not_before = 0.0

    def run(self) -> int:
        """Do a little of what is due; returns how many codes were filled in."""
        if (
            self._database.is_sqlite
            or self._database.read_only
            or self._choosing.setting == "local"
            or time.monotonic() < self._not_before
        ):
            return 0
        try:
            with self._database.write(turn=False) as turn:
                allow(turn, 0)  # it does nothing itself, for as long as a graph takes
                if not fits.take_turn(turn):
                    return 0
                return self._step(time.monotonic() + STEP_S)
        except (SceneprintError, SQLAlchemyError) as error:  # it costs nobody anything but time
            self._not_before = time.monotonic() + PAUSE_S
            log.error("codes are not brought on", extra={"error": f"{error!s:.500}"})
            return 0

    def _step(self, until: float) -> int:
        with self._database.read() as connection:
            rows = list_maps(connection)
            known = fits.list_fits(connection)
            wanted = {model for row in rows for model in models_of(row)}
            leftovers = fits.leftovers(connection, wanted)
        for number in leftovers:
            with suppress(StoreLocked), self._database.write() as connection:
                fits.drop_fit(connection, number)
        filled = 0
        for model_id in sorted(wanted):
            own = [fit for fit in known if fit.model_id == model_id and fit.number not in leftovers]
            filled += self._bring_on(model_id, rows, own, until)
        return filled

    def _bring_on(
        self, model_id: str, rows: Sequence[MapRow], own: Sequence[Fit], until: float
    ) -> int:
        asked = [row for row in rows if row.model_id == model_id]
        live = next((fit for fit in own if fit.state == "live"), None)
        filling = next((fit for fit in own if fit.state == "filling"), None)
        if filling is None and self._is_outgrown(model_id, asked, live):
            filling = self._fit(model_id, asked)
        if filling is not None:
            signed = [row for row in rows if model_id in models_of(row)]
            return self._fill(filling, signed, asked, until)
        return 0 if live is None else self._top_up(live, asked, until)

    # a fit

    def _is_outgrown(self, model_id: str, rows: Sequence[MapRow], live: Fit | None) -> bool:
        least = WHOLE if self._choosing.setting == "auto" else SHORTLIST
        if live is not None:
            least = GROWTH * live.fitted_on - 1
        if sum(row.revision for row in rows) <= least:  # spares the counting
            return False
        counted, n = self._counted.get(model_id, (-COUNT_S, 0))
        if live is None or time.monotonic() - counted >= COUNT_S:
            with self._database.read() as connection:
                n = sum(vectors.sizes(connection, [row.number for row in rows]).values())
            self._counted[model_id] = time.monotonic(), n
        return n > least

    def _fit(self, model_id: str, rows: Sequence[MapRow]) -> Fit | None:
        """A code of all maps of a model; None where there can be none."""
        with self._database.write() as connection:
            reason = fits.prepare(connection)
        if reason is not None:
            self._not_before = time.monotonic() + AGAIN_S
            log.warning("no shortlist in the database: %s", reason)
            return None
        numbers = [row.number for row in rows]
        with self._database.read() as connection:
            n = sum(vectors.sizes(connection, numbers).values())
            chosen = vectors.at_places(connection, numbers, draw(n, SAMPLE, 0).tolist())
            sample = list(_sound(connection, chosen, model_id).values())
        if not sample:
            return None
        code = fit_code(np.stack(sample))
        with self._database.write(turn=False) as connection:
            content = write_code(code)
            fit = fits.add_fit(connection, model_id, code.id, content, len(code.matrix), n)
        log.info("code fitted", extra={"fit": fit.number, "frames": n, "maps": len(rows)})
        return fit

    def _fill(
        self, fit: Fit, signed: Sequence[MapRow], asked: Sequence[MapRow], until: float
    ) -> int:
        """Fill the table of a fit that is not asked yet; when all are there, it is asked."""
        state = self._filling.setdefault(fit.number, _Filling())
        filled = 0
        while True:
            with self._database.read() as connection:
                if not state.revisions:
                    state.revisions = {row.number: row.revision for row in list_maps(connection)}
                numbers = [row.number for row in signed]
                block = codes.without_code(connection, fit, numbers, state.after, BLOCK)
                made = self._encoded(connection, fit, block)
            if block:
                self._put(fit, made)
                filled += len(made)
                state.after = block[-1]
            elif not state.last:
                graphs.add_graph_beside(self._database, fit)
                self._filling[fit.number] = state = _Filling(last=True)
            else:
                self._go_live(fit, asked, state.revisions)
                return filled
            if time.monotonic() >= until:
                return filled

    def _go_live(self, fit: Fit, rows: Sequence[MapRow], revisions: Mapping[int, int]) -> None:
        with self._database.write() as connection:
            fits.make_live(connection, fit)
            for row in rows:
                if row.number in revisions:
                    codes.set_complete(connection, fit, row.number, revisions[row.number])
        self._filling.pop(fit.number, None)
        self._checked[fit.number] = time.monotonic()
        log.info("codes are asked", extra={"fit": fit.number})

    # what came since

    def _top_up(self, fit: Fit, rows: Sequence[MapRow], until: float) -> int:
        """Fill in what no worker wrote with its signature."""
        self._check(fit, rows)
        with self._database.read() as connection:
            complete = codes.complete_up_to(connection, fit)
        filled = 0
        for row in rows:
            while complete.get(row.number, 0) < row.revision and time.monotonic() < until:
                with self._database.read() as connection:
                    block = sorted(codes.uncoded(connection, fit, [row.number], BLOCK))
                    made = self._encoded(connection, fit, block)
                self._put(fit, made)
                filled += len(made)
                if not block:
                    with self._database.write(turn=False) as connection:
                        codes.set_complete(connection, fit, row.number, row.revision)
                if len(block) < BLOCK or not made:  # damaged ones are compared until signed again
                    break
        return filled

    def _check(self, fit: Fit, rows: Sequence[MapRow]) -> None:
        """See now and then that there are as many codes as frames; if not, look at all."""
        if time.monotonic() - self._checked.get(fit.number, -CHECK_S) < CHECK_S:
            return
        self._checked[fit.number] = time.monotonic()
        with self._database.read() as connection:
            there = codes.count_codes(connection, fit)
            n = sum(vectors.sizes(connection, [row.number for row in rows]).values())
        if there != n:
            with self._database.write(turn=False) as connection:
                allow(connection, 0)
                gone = codes.sweep(connection, fit)
                codes.forget_complete(connection, fit)
            log.info("codes are looked through", extra={"fit": fit.number, "removed": gone})

    def _encoded(
        self, connection: Connection, fit: Fit, numbers: Collection[int]
    ) -> dict[int, Floats32]:
        read = _sound(connection, numbers, fit.model_id)
        if not read:
            return {}
        made = self._choosing.code_of(connection, fit).encode(np.stack(list(read.values())))
        return dict(zip(read, made, strict=True))

    def _put(self, fit: Fit, made: Mapping[int, Floats32]) -> None:
        if made:
            with self._database.write(turn=False) as connection:
                codes.put_codes(connection, fit, made)


def _sound(connection: Connection, numbers: Collection[int], model_id: str) -> dict[int, Bytes]:
    """Signatures of frames, but for damaged ones."""
    read = vectors.vectors(connection, numbers, model_id) if numbers else []
    return {
        number: np.frombuffer(vector, np.uint8)
        for number, vector, checksum in read
        if zlib.crc32(vector) == checksum
    }
