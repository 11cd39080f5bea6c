"""Creation, editing, deletion and re-encoding of maps, and the models for them.

    begin_reencoding  -->  jobs  -->  second signatures of all frames  --Reencodings.run-->  switch

While a map is re-encoded, queries use its current model. Once all frames have signatures of the
next model, one commit switches the map. Any process continues an interrupted re-encoding.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import Connection, select

from sceneprint import errors
from sceneprint.engine.context import Context
from sceneprint.engine.ingest import frame_decoder
from sceneprint.engine.ingest.frame_decoder import base_of, columns, viewpoint_of
from sceneprint.engine.search.local_index import trusted
from sceneprint.engine.serializers import (
    frame_records,
    frame_tag,
    map_record,
    map_records,
    map_tag,
    model_label,
    transform,
    when,
)
from sceneprint.engine.upkeep.garbage_collection import collect_blobs, collect_deleted_blobs
from sceneprint.engine.upkeep.index_upkeep import Upkeep
from sceneprint.index.index_version import IndexVersion
from sceneprint.models import PRESETS, Model, parse_model, read_model, write_model
from sceneprint.store import Database, Store, signatures
from sceneprint.store import reencoding_rows as stored
from sceneprint.store.audit_log import record_change
from sceneprint.store.deletion import remove_map
from sceneprint.store.frames import write_frame, write_map
from sceneprint.store.maps import (
    add_map,
    find_frame,
    find_map,
    list_maps,
    model_content,
    model_names,
    store_model,
)
from sceneprint.store.parent_joins import root_columns
from sceneprint.store.queue import cancel_jobs
from sceneprint.store.tables import FrameRow, MapRow, jobs, models
from sceneprint.store.wakeup import Wakeup
from sceneprint_client.api import Frame, FrameMeta, FrameState, Map, NewMap
from sceneprint_client.api.admin import ModelInfo
from sceneprint_client.api.base import ROS_NAMES, record_of
from sceneprint_client.api.listing import FrameEdit, MapEdit

#: Fields of a new map that limit its size or the age of its frames.
LIMITS = frozenset(("quota_frames", "quota_bytes", "retention_days"))


def create_map(store: Store, new: NewMap) -> tuple[Map, bool]:
    """Create a map, or return an existing one with the same properties.

    Returns
    -------
    record : record of the map
    new : whether the map was created

    Raises
    ------
    MapExists : If a map of this name exists with different properties.
    """
    model = read_model(new.model)
    limits: dict[str, Any] = new.model_dump(include=set(LIMITS & new.model_fields_set))
    if new.up is not None:
        limits["up"] = new.up.unit
    with store.database.write() as connection:
        existing = {row.name: row for row in list_maps(connection)}.get(new.name)
        if existing is None:
            store_model(connection, model.id, model.name, write_model(model))
            row = add_map(connection, new.name, new.title, model.id, limits)
            return map_record(connection, row), True
        differs = any(getattr(existing, name) != value for name, value in limits.items())
        if differs or (existing.title, existing.model_id) != (new.title, model.id):
            raise errors.MapExists(
                f"Map {new.name!r} already exists, but its title, model, limits or up vector "
                "differ. Use the existing map, delete it, or choose another name."
            )
        return map_record(connection, existing), False


def get_maps(store: Store) -> list[Map]:
    """Return all maps, sorted by name."""
    with store.database.read() as connection:
        return map_records(connection, list_maps(connection))


def get_map(store: Store, name: str) -> Map:
    """Return a map; raise UnknownMap if it does not exist."""
    with store.database.read() as connection:
        return map_record(connection, find_map(connection, name))


def delete_map(context: Context, name: str) -> None:
    """Delete a map with its frames and queries; raise UnknownMap if it does not exist."""
    store = context.store
    context.query_log.remove_of_map(name)  # other processes can write between its blocks
    with store.database.write() as connection:
        blobs = remove_map(connection, find_map(connection, name))
    context.readers.forget(name)
    collect_deleted_blobs(store, blobs)


#: Columns of each editable field.
_COLUMNS = {
    "robot": ("robot",),
    "session": ("session",),
    "captured_at": ("captured_at",),
    "tags": ("tags",),
    "pose": ("pose_parent", "pose"),
    "T_base_sensor": ("base_frame", "base"),
    "up": ("up",),
    "name": ("name",),
    "sequence": ("sequence",),
}
_CONTENT = (
    "intrinsics", "depth_scale", "depth_along_ray", "viewpoint", "units_per_metre", "format",
)  # fmt: skip
#: Fields that define a transform.
_WAYS = ("translation", "rotation", "matrix", *ROS_NAMES)


def edit_frame(
    store: Store, map_name: str, frame_id: str, patch: Mapping[str, Any],
    if_match: Collection[str] | None = None,
) -> Frame:  # fmt: skip
    """Edit the metadata of a frame with a JSON merge patch (RFC 7396); return the frame.

    A pose in a joined parent frame is converted to the root frame.

    Parameters
    ----------
    map_name, frame_id : map and id of a frame in any state
    patch : fields of FrameEdit to change; None removes a value
    if_match : entity tags from `frame_tag` that permit the edit; None always permits it

    Raises
    ------
    UnknownMap, UnknownFrame : If the map or the frame does not exist, or the frame was deleted.
    InvalidRequest : If a field is unknown, not editable or not valid.
    InvalidPose : If a transform is not rigid.
    PreconditionFailed : If the entity tag of the frame is not in `if_match`.
    """
    _check_fields(patch)
    with store.database.write() as connection:
        row = find_map(connection, map_name)
        frame = find_frame(connection, row, frame_id)
        if frame.state == FrameState.DELETED:
            raise errors.UnknownFrame(f"Frame {frame.id} of map {row.name!r} was already deleted.")
        _check_tag(f"Frame {frame.id}", frame_tag(frame), if_match)
        values = edited(frame, patch)
        if "pose_parent" in values:  # the new parent frame may be joined to a root frame
            values = {"sent_parent": None, "sent_pose": None, **values}
            values |= root_columns(connection, replace(frame, **values))
        now = write_frame(connection, row, frame, values)
        return frame_records(connection, row, [now])[0]


def edit_map(
    store: Store, map_name: str, patch: Mapping[str, Any],
    if_match: Collection[str] | None = None, *, dry_run: bool = False,
) -> Map:  # fmt: skip
    """Edit the title, the limits and the up vector of a map; return the map. See `edit_frame`.

    The caller must check the permission to set quotas. With `dry_run`, nothing is stored.
    """
    change = record_of(MapEdit, dict(patch), "The edit of the map")
    values = change.model_dump(include=change.model_fields_set)
    if change.up is not None:
        values["up"] = change.up.unit
    with store.database.read() if dry_run else store.database.write() as connection:
        row = find_map(connection, map_name)
        _check_tag(f"Map {row.name!r}", map_tag(row), if_match)
        if dry_run:
            return map_record(connection, replace(row, **values))
        return map_record(connection, write_map(connection, row, values))


def edited(frame: FrameRow, patch: Mapping[str, Any]) -> dict[str, Any]:
    """Return the new values of the columns that a patch changes; see `edit_frame` for errors."""
    meta = _merged(frame, patch)
    if meta.pose is not None and meta.pose.of != "sensor":
        raise errors.InvalidRequest(
            "An edit cannot set the pose of the base. Send the pose of the sensor, without `of`.",
            (("pose.of", "must be the pose of the sensor"),),
        )
    pose = None if meta.pose is None else frame_decoder.pose_matrix(meta.pose)
    columns_after = columns(meta, pose, base_of(meta.T_base_sensor, viewpoint_of(frame)))
    values = {name: columns_after[name] for field in patch for name in _COLUMNS[field]}
    for field, column in (("pose", "pose"), ("T_base_sensor", "base")):
        change = patch.get(field)
        if change is not None and not any(way in change for way in _WAYS):
            del values[column]  # the patch changes only the name of the frame
    return values


def _merged(frame: FrameRow, patch: Mapping[str, Any]) -> FrameMeta:
    """Return the upload metadata of a frame after a patch."""
    values = {
        "robot": frame.robot,
        "session": frame.session,
        "captured_at": when(frame.captured_at),
        "tags": frame.tags,
        "pose": _relative_transform(frame.pose, "parent_frame", frame.pose_parent),
        "T_base_sensor": _relative_transform(frame.base, "base_frame", frame.base_frame),
        "up": frame.up,
        "name": frame.name,
        "sequence": frame.sequence,
    }
    for field, change in patch.items():
        is_transform = field in ("pose", "T_base_sensor") and isinstance(change, Mapping)
        values[field] = _merge_transform(values[field], change) if is_transform else change
    fields = {name: value for name, value in values.items() if value is not None}
    return record_of(FrameMeta, {"intrinsics": frame.intrinsics, **fields}, "The edit of the frame")


def _relative_transform(
    matrix: list[list[float]] | None, name: str, frame: str | None
) -> dict[str, Any] | None:
    return None if matrix is None else {name: frame, "matrix": matrix}


def _merge_transform(now: Mapping[str, Any] | None, change: Mapping[str, Any]) -> dict[str, Any]:
    """Return a transform after a patch; the result has only one of the two notations."""
    change = {ROS_NAMES.get(name, name): value for name, value in change.items()}
    old = dict(now or {})
    if "matrix" in old and ("translation" in change or "rotation" in change):
        T = transform(np.array(old.pop("matrix")), "", "")
        old |= {"translation": T.translation.model_dump(), "rotation": T.rotation.model_dump()}
    merged = {**old, **change}
    return {name: value for name, value in merged.items() if value is not None}


def _check_fields(patch: Mapping[str, Any]) -> None:
    for name in patch:
        if name in _CONTENT:
            raise errors.InvalidRequest(
                f"`{name}` is part of the identity of the frame and cannot be edited. Delete the "
                "frame, and upload it again with the correct value.",
                ((name, "cannot be edited"),),
            )
        if name not in FrameEdit.model_fields:
            raise errors.InvalidRequest(
                f"The edit of the frame has an unknown field {name!r:.80}. Its fields are "
                f"{', '.join(FrameEdit.model_fields)}.",
                ((name[:80], "unknown"),),
            )


def _check_tag(what: str, tag: str, if_match: Collection[str] | None) -> None:
    if if_match is not None and tag not in if_match:
        raise errors.PreconditionFailed(
            f'{what} was edited after you read it: its ETag is now "{tag}". Read it again, and '
            "send the edit with the new ETag in If-Match."
        )


log = logging.getLogger(__name__)

#: Maximum duration of a call that removes signatures of former models, seconds.
TIDY_S = 2.0


def begin_reencoding(store: Store, bell: Wakeup, map_name: str, model: str | Path | Model) -> Map:
    """Start to re-encode a map, or retry failed jobs if this has already started; return the map.

    Parameters
    ----------
    model : name of a preset, path of a model file, or loaded model

    Raises
    ------
    UnknownMap : If the map does not exist.
    UnreadableModel : If the model does not exist or cannot be read.
    Conflict : If the map already has this model, or is switching to a different one.
    """
    next_model = model if isinstance(model, Model) else read_model(model)
    with store.database.write() as connection:
        row = find_map(connection, map_name)
        if row.next_model_id not in (None, next_model.id):
            label = model_label(model_names(connection)[row.next_model_id], row.next_model_id)
            raise errors.Conflict(
                f"Map {row.name!r} is already switching to {label}. Wait until it has switched, "
                f"or cancel with `sceneprint reencode {row.name} --cancel`."
            )
        if row.next_model_id is None and row.model_id == next_model.id:
            raise errors.Conflict(f"Map {row.name!r} already uses the model {next_model.label}.")
        if row.next_model_id is None:
            store_model(connection, next_model.id, next_model.name, write_model(next_model))
            stored.begin_reencoding(connection, row, next_model.id)
            row = find_map(connection, row.name)
        else:
            record_change(connection, "map.reencoding_retried", row.name, model=next_model.id)
    _enqueue(store, row, again=True)
    bell.ring()
    with store.database.read() as connection:
        return map_record(connection, find_map(connection, map_name))


def cancel_reencoding(store: Store, map_name: str) -> Map:
    """Cancel the re-encoding of a map, remove signatures of the next model, and return the map.

    Raises
    ------
    UnknownMap : If the map does not exist.
    Conflict : If the map is not switching to another model.
    """
    with store.database.write() as connection:
        row = find_map(connection, map_name)
        if row.next_model_id is None:
            raise errors.Conflict(
                f"Map {row.name!r} is not switching to another model. To undo a finished switch, "
                "run `sceneprint reencode` with --model and the previous model."
            )
        stored.cancel_reencoding(connection, row)
    _tidy(store, row)
    with store.database.read() as connection:
        return map_record(connection, find_map(connection, map_name))


class Reencodings:
    """Re-encodings of all maps; before a switch, `upkeep` publishes the index of the next model."""

    def __init__(self, store: Store, upkeep: Upkeep) -> None:
        self._store, self._upkeep = store, upkeep
        self._tidied: dict[int, tuple[str, ...]] = {}  # models of maps without obsolete signatures

    def run(self) -> None:
        """Continue the re-encodings of all maps; log errors of single maps."""
        with self._store.database.read() as connection:
            rows = list_maps(connection)
        for row in rows:
            try:
                models = stored.models_of(row)
                if row.next_model_id is not None and self._continue(row):
                    models = (row.next_model_id,)
                if self._tidied.get(row.number) != models and _tidy(self._store, row, TIDY_S):
                    self._tidied[row.number] = models
            except errors.UnknownMap:
                pass
            except errors.SceneprintError as error:
                log.error("map not reencoded", extra={"map": row.name, "error": str(error)})

    def _continue(self, row: MapRow) -> bool:
        """Continue the re-encoding of a map; return whether the map has switched."""
        with self._store.database.read() as connection:
            if stored.is_pending(connection, row):
                return False
        if _enqueue(self._store, row):
            return False
        with self._store.database.read() as connection:
            if not stored.is_complete(connection, row):
                return False  # the operator must retry failed jobs or cancel
        try:
            version = self._upkeep.publish_next(row)
        except errors.BusyIndex:
            return False
        return self._switch(row, version)

    def _switch(self, row: MapRow, version: IndexVersion | None) -> bool:
        """Switch a complete re-encoding to the next model; return False if it is not complete."""
        with self._store.database.write() as connection:
            now = find_map(connection, row.name)
            if not _is_same_switch(now, row) or not stored.is_complete(connection, now):
                return False  # a frame was indexed meanwhile, or another process switched the map
            usable = trusted(connection, now, version)
            if usable is not None:
                # raise the revisions of frames that were signed after the index was built
                signed = stored.frames_signed_by(connection, now, usable.revision)
                stored.raise_revisions(connection, now, np.setdiff1d(signed, usable.keys).tolist())
            rejected = stored.switch_model(connection, now)
        log.info(
            "map reencoded",
            extra={"map": row.name, "model": row.next_model_id, "rejected": len(rejected)},
        )
        return True


def _enqueue(store: Store, row: MapRow, *, again: bool = False) -> int:
    """Queue jobs for frames without a signature of the next model; return their number.

    With `again`, this includes frames whose job has failed.
    """
    after, queued = 0, 0
    while True:
        with store.database.read() as connection:  # usually none exist: avoid a write lock
            if not stored.unqueued_frames(connection, row, after, again=again):
                return queued
        with store.database.write() as connection:
            if not _is_same_switch(find_map(connection, row.name), row):
                return queued
            numbers = stored.unqueued_frames(connection, row, after, again=again)
            stored.enqueue_all(connection, row, numbers)
        if numbers:
            after, queued = numbers[-1], queued + len(numbers)


def _tidy(store: Store, row: MapRow, at_most_s: float = math.inf) -> bool:
    """Remove jobs and signatures of former models of a map, for about `at_most_s` seconds.

    Return whether all were removed.
    """
    start = time.monotonic()
    while True:
        with store.database.read() as connection:
            if not signatures.stale_jobs(connection, find_map(connection, row.name)):
                break
        with store.database.write() as connection:
            now = find_map(connection, row.name)
            stale = signatures.stale_jobs(connection, now)
            cancel_jobs(connection, jobs.c.number.in_(stale))
    after = 0
    while True:
        with store.database.read() as connection:
            if not signatures.stale_signatures(connection, find_map(connection, row.name), after):
                return True
        if time.monotonic() - start > at_most_s:
            return False
        blobs: list[str] = []
        with store.database.write() as connection:
            now = find_map(connection, row.name)
            for number, model_id in signatures.stale_signatures(connection, now, after):
                blobs += signatures.remove_signature(connection, number, model_id)
                after = number - 1  # a frame may have several signatures
        collect_blobs(store, blobs)


def _is_same_switch(now: MapRow, row: MapRow) -> bool:
    return (now.number, now.next_model_id) == (row.number, row.next_model_id)


class Catalogue:
    """Presets and stored models, with a cache of parsed models."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._known: dict[str, Model] = {}

    def list_all(self, may_read: Callable[[str], bool]) -> list[ModelInfo]:
        """Return the records of all models: presets first, then the others sorted by label.

        Parameters
        ----------
        may_read : function that returns whether the caller may read a map. The records name only
            maps that the caller may read
        """
        with self._database.read() as connection:
            by_id = {model.id: model for model in self._stored(connection)}
            rows = list_maps(connection)
        shipped = [_preset(name) for name in PRESETS]
        by_id |= {model.id: model for model in shipped}
        ids = [model.id for model in shipped]
        rest = sorted((m for m in by_id.values() if m.id not in ids), key=lambda m: m.label)
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
        """Return a preset by its name, or a model by its id or label.

        Parameters
        ----------
        may_read : function that returns whether the caller may read a map. Models of other maps are
            hidden; None hides no model

        Raises
        ------
        InvalidRequest : If the model does not exist.
        """
        if name in PRESETS:
            return _preset(name)
        with self._database.read() as connection:
            rows = list_maps(connection)
            every = [*(_preset(name) for name in PRESETS), *self._stored(connection)]
        if may_read is not None:
            pairs = [(row.model_id, row.next_model_id) for row in rows if may_read(row.name)]
            visible = {model_id for pair in pairs for model_id in pair}
            every = [m for i, m in enumerate(every) if i < len(PRESETS) or m.id in visible]
        for model in every:
            if name in (model.id, model.label):
                return model
        raise errors.InvalidRequest(
            f"There is no model {name!r:.80}. Use {' or '.join(PRESETS)}, or an id that GET "
            "/v1/models lists; `sceneprint reencode --model FILE` adds a new model.",
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
                    continue  # a model of another version, which `sceneprint fsck` reports
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
