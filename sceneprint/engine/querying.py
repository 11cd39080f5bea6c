"""Queries of an engine: signed with the maps' model, and answered wholly with it.

upload | stored frame, names of maps  -->  Answer
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sceneprint.engine.answers import answer
from sceneprint.engine.asking import Asked, ask_stored, ask_upload
from sceneprint.engine.comparing import Side, compare
from sceneprint.engine.deadlines import Deadline
from sceneprint.engine.kept import Kept, KeptQueries
from sceneprint.engine.readers import Readers
from sceneprint.engine.searching import Place
from sceneprint.engine.signers import Signers
from sceneprint.engine.switches import check_model, steadily
from sceneprint.engine.wire import model_label
from sceneprint.errors import InvalidRequest, UnknownMap
from sceneprint.schemas import (
    Answer,
    Comparison,
    FrameMeta,
    NamedFrame,
    Query,
    SeveralQuery,
    Similarity,
)
from sceneprint.schemas.options import MOST_MAPS
from sceneprint.store import Store
from sceneprint.store.maps import find_maps, list_maps, model_names, unknown_map
from sceneprint.store.records import MapRow
from sceneprint.store.replica import asked

#: Maps that `*` asks at once where the database searches: by one statement, whatever their number.
#: Otherwise this node holds what is asked, and there are MOST_MAPS.
FLEET_MAPS = 1000


class Queries:
    """Asks one or more maps of one model.

    Parameters
    ----------
    store, signers, readers : of the engine
    kept : where answers are kept for a while
    """

    def __init__(self, store: Store, signers: Signers, readers: Readers, kept: KeptQueries) -> None:
        self._store, self._signers, self._readers = store, signers, readers
        self._kept = kept

    def upload(
        self, maps: Sequence[str], data: bytes, meta: FrameMeta, query: Query,
        since: float | None = None,
    ) -> Answer:  # fmt: skip
        """Look a frame up that is not kept; see `ask_upload`.

        Parameters
        ----------
        maps : their names, each once
        data, meta : the frame
        query : how to ask
        since : when the request came, by `time.perf_counter`; default: now

        Raises
        ------
        UnknownMap : one of them is none.
        InvalidRequest : they are of several models.
        """
        deadline = Deadline(query.deadline_ms, since)

        def ask(rows: list[MapRow]) -> Answer:
            self._check_models(rows)
            signer = self._signers(rows[0].model_id)
            return self.answer(rows, ask_upload(data, meta, signer, query), query, deadline)

        return asked(self._store.replica, lambda: steadily(self._store, maps, ask))

    def stored(
        self, maps: Sequence[str], frame: NamedFrame, query: Query, since: float | None = None
    ) -> Answer:
        """Look a stored frame up, which does not find itself; see `ask_stored` and `upload`."""
        deadline = Deadline(query.deadline_ms, since)

        def ask(rows: list[MapRow]) -> Answer:
            self._check_models(rows)
            self._signers(rows[0].model_id)  # while no connection is held: a crowd would hold all
            ready = ask_stored(self._store, frame.map, frame.frame_id, query)
            return self.answer(rows[: len(maps)], ready, query, deadline)

        home = [] if frame.map in maps else [frame.map]
        names = [*maps, *home]
        return asked(self._store.replica, lambda: steadily(self._store, names, ask))

    def answer(
        self, asked_of: Sequence[MapRow], asked: Asked, query: Query, deadline: Deadline
    ) -> Answer:
        """Answer from the maps as they are now; ModelMismatch where one has switched meanwhile."""
        database = self._store.queried
        with database.read() as connection:
            rows = find_maps(connection, [one.name for one in asked_of])
            for row, one in zip(rows, asked_of, strict=True):
                if row.number != one.number:
                    raise UnknownMap(
                        f"Map {row.name!r} was deleted and made anew while it was asked. Ask again."
                    )
                check_model(asked.model_id, row.model_id)
            views = self._readers.views(connection, database, rows)
        places = [Place(row, view) for row, view in zip(rows, views, strict=True)]
        for place in places:
            check_model(place.view.model_id, asked.model_id)
        model = self._signers(asked.model_id).model
        told, ranked = answer(self._store, places, model, asked, query, deadline)
        if query.keep:
            kept = Kept(
                told, query, asked.model_id, asked.vector, asked.artifact, ranked,
                taken=asked.taken, base=asked.base,
            )  # fmt: skip
            self._kept.keep(kept)
        return told

    def compare(self, a: Side, b: Side, how: Comparison) -> Similarity:
        """Compare two frames; see `comparing.compare`."""
        return compare(self._store, self._signers, a, b, how)

    def maps_of(
        self, query: SeveralQuery, may_read: Callable[[str], bool] = lambda _: True
    ) -> list[str]:
        """Names of the maps that a query asks, each once.

        Parameters
        ----------
        query : with their names, or `*` for all that may be read
        may_read : whether the caller may; what it may not is not there

        Raises
        ------
        UnknownMap : one of them is not there, or none is.
        InvalidRequest : they are more than may be asked at once.
        """
        if query.maps != "*":
            for name in query.maps:
                if not may_read(name):
                    raise unknown_map(name)
            return list(dict.fromkeys(query.maps))
        with self._store.database.read() as connection:
            names = [row.name for row in list_maps(connection) if may_read(row.name)]
            most = MOST_MAPS
            if len(names) > most and self._readers.asks_database(connection):
                most = FLEET_MAPS
        if not names:
            raise UnknownMap("There is no map to ask yet. Make one, or name one that is there.")
        if len(names) > most:
            raise InvalidRequest(
                f"There are {len(names)} maps, and {most} can be asked at once. Name them.",
                (("maps", f"more than {most}"),),
            )
        return names

    def _check_models(self, rows: Sequence[MapRow]) -> None:
        if len({row.model_id for row in rows}) == 1:
            return
        with self._store.queried.read() as connection:
            names = model_names(connection)
        told = {row.name: model_label(names[row.model_id], row.model_id) for row in rows}
        which = ", ".join(f"{name} has {model}" for name, model in told.items())
        raise InvalidRequest(
            f"Maps of several models cannot be asked as one: {which}. Ask those of one model, or "
            "change the model of the others with `sceneprint reencode`.",
            tuple((f"maps.{name}", f"is of {model}") for name, model in told.items()),
        )
