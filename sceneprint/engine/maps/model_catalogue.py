"""The models that a map can be signed with: those of the store, and the presets that ship."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import cache

from sqlalchemy import Connection, select

from sceneprint import errors
from sceneprint.models import PRESETS, Model, parse_model, read_model
from sceneprint.store import Database
from sceneprint.store.maps import list_maps, model_content
from sceneprint.store.tables import models
from sceneprint_client.api.admin import ModelInfo


class Catalogue:
    """Models by their ids; each is read once a process, as it never changes.

    Parameters
    ----------
    database : that holds those that maps were made with
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._known: dict[str, Model] = {}

    def tell(self, may_read: Callable[[str], bool]) -> list[ModelInfo]:
        """All that can be read: the presets first, then by label.

        Parameters
        ----------
        may_read : whether a map may be named
        """
        with self._database.read() as connection:
            found = {model.id: model for model in self._stored(connection)}
            rows = list_maps(connection)
        shipped = [_preset(name) for name in PRESETS]
        found |= {model.id: model for model in shipped}
        ids = [model.id for model in shipped]
        rest = sorted((one for one in found.values() if one.id not in ids), key=lambda m: m.label)
        return [
            _model_record(
                model,
                model.id in ids,
                [
                    row.name
                    for row in rows
                    if model.id in (row.model_id, row.next_model_id) and may_read(row.name)
                ],
            )
            for model in [*shipped, *rest]
        ]

    def find(self, name: str, may_read: Callable[[str], bool] | None = None) -> Model:
        """A model by the name of a preset, or by id or label.

        Parameters
        ----------
        name : see above
        may_read : whether a map may be named: a model that only others have is not there; default:
            all are

        Raises
        ------
        InvalidRequest : there is none.
        """
        if name in PRESETS:
            return _preset(name)
        with self._database.read() as connection:
            rows = list_maps(connection)
            known = [*(_preset(one) for one in PRESETS), *self._stored(connection)]
        if may_read is not None:
            of = [(row.model_id, row.next_model_id) for row in rows if may_read(row.name)]
            seen = {model_id for pair in of for model_id in pair}
            known = [one for i, one in enumerate(known) if i < len(PRESETS) or one.id in seen]
        for model in known:
            if name in (model.id, model.label):
                return model
        raise errors.InvalidRequest(
            f"There is no model {name!r:.80} here. Give {' or '.join(PRESETS)}, or the id of one "
            "that GET /v1/models lists; `sceneprint reencode --model FILE` adds a new one.",
            (("model", "no such model"),),
        )

    def _stored(self, connection: Connection) -> list[Model]:
        ids = list(connection.execute(select(models.c.id)).scalars())
        for model_id in ids:
            if model_id not in self._known:
                try:
                    content = model_content(connection, model_id)
                    self._known[model_id] = parse_model(content, f"model {model_id[:12]}")
                except errors.UnreadableModel:
                    continue  # another version stored it; `sceneprint fsck` says so
        return [self._known[model_id] for model_id in ids if model_id in self._known]


@cache
def _preset(name: str) -> Model:
    return read_model(name)


def _model_record(model: Model, preset: bool, maps: list[str]) -> ModelInfo:
    return ModelInfo(
        model_id=model.id,
        label=model.label,
        name=model.name,
        preset=preset,
        components=len(model.mixture),
        levels=len(model.levels),
        signature_bytes=model.signature_bytes,
        metric=model.metric,
        unrelated_distance=model.unrelated_distance,
        parameters=asdict(model.parameters),
        provenance=dict(model.provenance),
        maps=maps,
    )
