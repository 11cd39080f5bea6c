"""Vectors of signatures in PostgreSQL, made and filled by workers beside everything else.

models of the maps  -->  a table for each dimension  --fill, block by block-->  complete, a graph
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from typing import Literal

from sqlalchemy.exc import SQLAlchemyError

from sceneprint.engine.models import Signers
from sceneprint.errors import ModelError, SceneprintError
from sceneprint.store.maps import list_maps
from sceneprint.store.model_switch import models_of
from sceneprint.store.postgres import vectors

log = logging.getLogger(__name__)

Setting = Literal["auto", "local", "database"]

#: Frames that a node reads of maps before it would ask the database instead, if it can.
READ_MOST = 20_000
#: Seconds for which a worker adds vectors before it looks for frames to sign again.
STEP_S = 2.0
#: Seconds between two looks for what is missing.
LOOK_S = 10.0
#: Seconds until another try where the database has no pgvector, and after any other error.
AGAIN_S, PAUSE_S = 600.0, 30.0


class VectorTables:
    """Keeps a table of vectors for each dimension that the maps of this database need.

    Parameters
    ----------
    signers : that know the models, and the database
    setting : with `local` there are none; with `auto` none that no node would ask
    """

    def __init__(self, signers: Signers, setting: Setting) -> None:
        self._signers, self._database, self._setting = signers, signers.database, setting
        self._not_before = 0.0

    def run(self) -> bool:
        """Do a little of what is due; returns whether there is more to do at once."""
        database = self._database
        if database.is_sqlite or database.read_only or self._setting == "local":
            return False
        if time.monotonic() < self._not_before:
            return False
        try:
            until = time.monotonic() + STEP_S
            more = [self._bring_on(dimension, until) for dimension in self._wanted()]
        except (SceneprintError, SQLAlchemyError) as error:  # it costs nobody anything but time
            self._not_before = time.monotonic() + PAUSE_S
            log.error("vector table update failed", extra={"error": f"{error!s:.500}"})
            return False
        if not any(more) and time.monotonic() > self._not_before:
            self._not_before = time.monotonic() + LOOK_S
        return any(more)

    def _wanted(self) -> list[int]:
        """Dimensions of the models in use whose signatures are compared by L2."""
        frames: Counter[int] = Counter()
        with self._database.read() as connection:
            rows = list_maps(connection)
        for row in rows:
            for model_id in models_of(row):
                try:
                    model = self._signers(model_id).model
                except ModelError:  # its maps can be neither signed nor searched; `warm` says so
                    continue
                if model.metric == "l2":
                    frames[model.signature_bytes] += row.used_frames
        least = READ_MOST if self._setting == "auto" else -1
        return sorted(dimension for dimension, n in frames.items() if n > least)

    def _bring_on(self, dimension: int, until: float) -> bool:
        with self._database.read() as connection:
            complete = dimension in vectors.complete_dimensions(connection)
        if not complete:
            with self._database.write() as connection:
                reason = vectors.make_table(connection, dimension)
            if reason is not None:
                self._not_before = time.monotonic() + AGAIN_S
                log.warning("database search disabled: %s", reason)
                return False
        while not complete:
            with self._database.write() as connection:
                complete = vectors.fill(connection, dimension)
            if time.monotonic() >= until:
                break
        if complete and vectors.add_graph(self._database, dimension):
            log.info("vector index built", extra={"dimension": dimension})
        return not complete
