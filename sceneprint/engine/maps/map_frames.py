"""Read access to maps: frames, sessions, trajectories, and data derived from frames."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from sceneprint import errors
from sceneprint.engine.ingest.frame_decoder import read_stored
from sceneprint.engine.serializers import frame_records, model_label, sensor_of, tag_of, when
from sceneprint.engine.signers import Signers
from sceneprint.engine.upkeep.repair import rebuild_frame, resign_frames
from sceneprint.formats.artifact import read_geometry
from sceneprint.formats.dataset import trajectory_row, trajectory_text
from sceneprint.formats.depth_file import encode_npy
from sceneprint.formats.export import points_of, write_ply
from sceneprint.geometry.rigid import transform_points
from sceneprint.pictures import (
    depth_view,
    normals_view,
    patches_view,
    picture,
    project_labels,
    vista_of,
)
from sceneprint.signing import hierarchy_of, see
from sceneprint.store import Store, frame_queries
from sceneprint.store.frame_queries import (
    CapturePosition,
    RunSummary,
    count_run,
    list_runs,
    poses_of_run,
    stamps_of_run,
)
from sceneprint.store.maps import find_frame, find_map, geometry_blobs, model_names
from sceneprint.store.opaque_ids import invalid_cursor
from sceneprint.store.signatures import patch_counts, stored_vector
from sceneprint.store.tables import FrameRow, MapRow
from sceneprint.types import Geometry, Hierarchy, Intrinsics, Ints32, Patches, Surface
from sceneprint_client.api import Frame, FrameState, Page
from sceneprint_client.api.base import MOST_SEQUENCE
from sceneprint_client.api.listing import FrameListing, Run, Session, Trajectory
from sceneprint_client.api.results import CloudFrame, FramePatches, FrameSignature, PatchLevel, View
from sceneprint_client.formats import BYTES, format_at

#: Version of derived data in entity tags; increment it when the bytes of derived data change.
FORM = 1


@dataclass(frozen=True, eq=False)
class IndexedFrame:
    """An indexed frame with its map, its model, and the digest of its geometry."""

    row: MapRow
    frame: FrameRow
    label: str
    artifact: str

    def tag(self, what: str, *options: object) -> str:
        """Return the entity tag of the derived data `what`, computed with `options`."""
        return tag_of(what, FORM, self.frame.content_id, self.row.model_id, *options)


def find_indexed(store: Store, map_name: str, frame_id: str) -> IndexedFrame:
    """Return an indexed frame.

    Raises
    ------
    UnknownMap, UnknownFrame : If the map or the frame does not exist, or the frame was deleted.
    NotIndexed : If the frame has another state.
    """
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        frame = living(row, find_frame(connection, row, frame_id))
        artifacts = geometry_blobs(connection, [frame.number], row.model_id)
        label = model_label(model_names(connection)[row.model_id], row.model_id)
    if frame.state != FrameState.INDEXED or frame.number not in artifacts:
        raise errors.NotIndexed(
            f"Frame {frame.id} is {frame.state}: {frame.state.sentence} Derived data is "
            "available once the frame is indexed."
        )
    return IndexedFrame(row, frame, label, artifacts[frame.number])


def living(row: MapRow, frame: FrameRow) -> FrameRow:
    """Return `frame` unchanged; raise UnknownFrame if it was deleted."""
    if frame.state == FrameState.DELETED:
        raise errors.UnknownFrame(f"Frame {frame.id} of map {row.name!r} was deleted.")
    return frame


def geometry_of(store: Store, signers: Signers, indexed: IndexedFrame) -> Geometry:
    """Return the geometry of a frame; if it is damaged, rebuild it from the upload, and queue a job
    that repairs it.

    Raises
    ------
    DamagedBlob : If the upload is damaged as well.
    UnknownFrame, NotIndexed, Busy : See `check_unchanged`.
    """
    try:
        return read_geometry(store.blobs.get(indexed.artifact))
    except (errors.DamagedBlob, errors.UnreadableGeometry):
        check_unchanged(store, indexed)
        resign_frames(store, indexed.row, [indexed.frame.number], indexed.row.model_id)
    _, artifact = rebuild_frame(store, signers(indexed.row.model_id), indexed.frame)
    return read_geometry(artifact)


def check_unchanged(store: Store, indexed: IndexedFrame) -> None:
    """Check that a frame is still indexed with the same model as when it was read.

    Raises
    ------
    UnknownFrame, NotIndexed : If the frame was deleted or is no longer indexed.
    Busy : If the frame was signed with another model.
    """
    now = find_indexed(store, indexed.row.name, indexed.frame.id)
    if (now.frame.number, now.artifact) != (indexed.frame.number, indexed.artifact):
        raise errors.Busy(
            f"Frame {indexed.frame.id} was signed with another model during the request. Try again."
        )


#: Maximum number of poses in a trajectory.
MOST_POSES = 100_000
#: Maximum number of parent frames, and of tags, in the record of a session.
_MOST_NAMES = 20


def list_frames(
    store: Store, map_name: str, listing: FrameListing, cursor: str | None, limit: int
) -> Page[Frame]:
    """Return a page of the frames that pass a filter, in the requested order.

    Raises
    ------
    UnknownMap : If the map does not exist.
    InvalidRequest : If the service did not issue the cursor.
    """
    beyond = _position_of(store, cursor, listing)
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        rows = frame_queries.list_frames(connection, row.number, beyond, limit + 1, listing)
        items = frame_records(connection, row, rows[:limit])
    more = _position_cursor(store, rows[limit - 1], listing) if len(rows) > limit else None
    return Page[Frame](items=items, next_cursor=more)


def get_frame(store: Store, map_name: str, frame_id: str) -> Frame:
    """Return a frame; raise UnknownMap or UnknownFrame if it does not exist."""
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        return frame_records(connection, row, [find_frame(connection, row, frame_id)])[0]


def _position_cursor(store: Store, last: FrameRow, listing: FrameListing) -> str:
    """Return a cursor for the page after a frame: its sealed number and, if needed, sort key."""
    sealed = store.seals.seal("frame", last.number)
    if listing.order != "taken":
        return sealed
    return f"{sealed}~{_packed([last.captured_at, last.sequence])}"


def _position_of(store: Store, cursor: str | None, listing: FrameListing) -> CapturePosition | None:
    """Decode a cursor from `_position_cursor`; raise InvalidRequest if it is not authentic."""
    if cursor is None:
        return None
    if listing.order != "taken":
        number = store.seals.row("frame", cursor)
        return None if number is None else CapturePosition(number, None, None)
    sealed, _, values = cursor.partition("~")
    number = store.seals.row("frame", sealed)
    try:
        at, sequence = _unpacked(values)
        is_time = at is None or (isinstance(at, float) and math.isfinite(at))
        is_place = sequence is None or (
            isinstance(sequence, int) and 0 <= sequence <= MOST_SEQUENCE
        )
    except (ValueError, TypeError, RecursionError):
        is_time = is_place = False
    if number is None or not (is_time and is_place):
        raise invalid_cursor(cursor)
    return CapturePosition(number, at, sequence)


def list_sessions(store: Store, map_name: str, cursor: str | None, limit: int) -> Page[Session]:
    """Return a page of sessions, sorted by name and robot; frames without a session come first.

    Raises
    ------
    UnknownMap : If the map does not exist.
    InvalidRequest : If the service did not issue the cursor.
    """
    after = None if cursor is None else _names_of(cursor)
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        runs = list_runs(connection, row.number, after, limit + 1)
    more = len(runs) > limit
    items = [_session(run) for run in runs[:limit]]
    last = runs[limit - 1] if more else None
    cursor = None if last is None else _packed([last.session or "", last.robot or ""])
    return Page[Session](items=items, next_cursor=cursor)


def trajectory(store: Store, map_name: str, run: Run) -> Trajectory:
    """Return the poses of a run, sorted by time stamp, with one pose per stamp.

    Raises
    ------
    UnknownMap : If the map does not exist.
    InvalidRequest : If the robot or the parent frame is ambiguous, or the run has more than
        MOST_POSES frames.
    """
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        counts = count_run(connection, row.number, run)
        robot = _only("robot", run.robot, {name for name, _, _ in counts}, run.session)
        parents = {name for _, name, _ in counts if name is not None}
        parent = _only("parent_frame", run.parent_frame, parents, run.session)
        total = sum(count for _, _, count in counts)
        if run.most is None and total > MOST_POSES:
            raise errors.InvalidRequest(
                f"Session {run.session!r:.140} has {total} frames, but a trajectory has at most "
                f"{MOST_POSES}. Limit it with `most`, or select a part with `captured_after` and "
                "`captured_before`.",
                (("session", "too many frames"),),
            )
        only = run.model_copy(update={"robot": robot, "parent_frame": parent})
        stamps = None if parent is None else stamps_of_run(connection, row.number, only)
        selected: list[tuple[str, float, list[list[float]]]] = []
        posed = 0
        if stamps is not None:
            selected, posed = poses_of_run(connection, row.number, only, stamps)
    return Trajectory(
        map=row.name,
        session=run.session,
        robot=robot,
        parent_frame=parent,
        frame_ids=[frame_id for frame_id, _, _ in selected],
        poses=[trajectory_row(at, np.array(pose)) for _, at, pose in selected],
        posed=posed,
        left_out=total - len(selected),
        stamps=stamps if selected else None,
        reason=None if selected else _why_empty(only, total, posed=bool(parents)),
    )


def _why_empty(run: Run, total: int, *, posed: bool) -> str:
    """Return an explanation of why a trajectory is empty."""
    if not total:
        part = run.captured_after is not None or run.captured_before is not None
        return f"the map has no frame of session {run.session!r:.140}{' in this period' * part}"
    if not posed:
        return f"none of its {total} frames has a pose; send `pose` with uploads, or edit them"
    where = "" if run.parent_frame is None else f" in {run.parent_frame!r:.140}"
    lacking = {
        "taken": " with `captured_at` or `sequence`; `clock=received` orders them by upload",
        "captured": " with `captured_at`", "sequence": " with `sequence`", "received": "",
    }[run.clock]  # fmt: skip
    return f"none of its {total} frames has a pose{where}{lacking}"


#: Descriptions of time stamps, for comments in a file.
_STAMPS = {
    "captured": "captured_at, seconds since 1970",
    "received": "when it was received, seconds since 1970",
    "sequence": "sequence, place within the session",
}


def trajectory_file(track: Trajectory) -> str:
    """Return a trajectory as a text file in TUM format, with comments on its origin."""
    robot = "" if track.robot is None else f", robot {track.robot}"
    number = f"{len(track.poses)}"
    if track.posed > len(track.poses):
        number += f" of {track.posed}, evenly spaced"
    comments = [
        f"map {track.map}, session {track.session}{robot}",
        f"poses of sensor frames in {track.parent_frame or 'no frame'}, metres",
        f"poses: {number}; frames left out: {track.left_out}",
        f"empty: {track.reason}" if track.stamps is None else f"t: {_STAMPS[track.stamps]}",
        "t tx ty tz qx qy qz qw",
    ]
    return trajectory_text(track.poses, comments)


def _only(what: str, choice: str | None, names: Iterable[str | None], session: str) -> str | None:
    """Return `choice`, else the only name in `names`; raise InvalidRequest if it has several."""
    if choice is not None:
        return choice
    names = sorted(set(names), key=lambda name: name or "")
    if len(names) > 1:
        shown = ", ".join("none" if name is None else repr(name)[:60] for name in names[:5])
        raise errors.InvalidRequest(
            f"Session {session!r:.140} has frames with {len(names)} values of `{what}` ({shown}), "
            f"but a trajectory covers only one. Select one with `{what}`.",
            ((what, "required, since there are several"),),
        )
    return names[0] if names else None


def _session(run: RunSummary) -> Session:
    return Session(
        robot=run.robot,
        session=run.session,
        frames=dict(sorted(run.states.items())),
        with_pose=run.posed,
        first_captured_at=when(run.first),
        last_captured_at=when(run.last),
        parent_frames=[name for name, _ in run.parents.most_common(_MOST_NAMES)],
        tags=[name for name, _ in run.tags.most_common(_MOST_NAMES)],
    )


def _names_of(cursor: str) -> tuple[str, str]:
    try:
        session, robot = _unpacked(cursor)
        if isinstance(session, str) and isinstance(robot, str):
            f"{session}{robot}".encode()  # fails for lone surrogates
            return session, robot
    except (ValueError, TypeError, RecursionError):
        pass
    raise invalid_cursor(cursor)


def _packed(values: list[Any]) -> str:
    return base64.urlsafe_b64encode(json.dumps(values).encode()).decode().rstrip("=")


def _unpacked(text: str) -> Any:
    return json.loads(base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)))


T = TypeVar("T")

PLY, PNG, NPY, JSON = "application/ply", "image/png", "application/x-npy", "application/json"


@dataclass(frozen=True, eq=False)
class Output(Generic[T]):
    """Derived data of a frame, computed on demand.

    Parameters
    ----------
    tag : entity tag, which changes with the data
    make : function that computes the data, usually within 100 ms
    blob : digest of the blob that contains the data; None if `make` computes it
    """

    tag: str
    make: Callable[[], T]
    blob: str | None = None


def upload_type(data: bytes) -> tuple[str, str]:
    """Return the media type of an upload, and its file name suffix."""
    kind = format_at(data, "depth", "cloud")
    if kind is None:  # KITTI scans have no magic bytes
        return BYTES, ".bin"
    return kind.media_type, next(iter(kind.suffixes), ".bin")


def level_of(patches: Patches) -> PatchLevel:
    """Convert patches to their API record."""
    return PatchLevel(
        mean=[(x, y, z) for x, y, z in patches.means.round(4).tolist()],
        normal=[(x, y, z) for x, y, z in patches.normals.round(4).tolist()],
        area_m2=patches.areas.round(5).tolist(),
        size=patches.sizes.tolist(),
    )


def npy_of(vector: bytes) -> bytes:
    """Convert bytes to an NPY file with a uint8 array (D,)."""
    return encode_npy(np.frombuffer(vector, np.uint8))


class FrameFiles:
    """Derived data and uploads of frames."""

    def __init__(self, store: Store, signers: Signers) -> None:
        self._store, self._signers = store, signers

    def cloud(self, map_name: str, frame_id: str, within: CloudFrame = "optical") -> Output[bytes]:
        """Return the points and normals of a frame as a PLY file.

        Parameters
        ----------
        within : coordinate frame of the points: the sensor, the parent frame, or the robot base

        Raises
        ------
        UnknownMap, UnknownFrame : If the map or the frame does not exist, or the frame was deleted.
        NotIndexed : If the frame is not indexed.
        InvalidRequest : If the frame lacks the pose or the base that `within` requires.
        """
        indexed = find_indexed(self._store, map_name, frame_id)
        frame, optical = indexed.frame, sensor_of(indexed.frame)
        name, matrix = placed(frame, within)
        comments = [f"frame {name}", f"points of {optical} of map {indexed.row.name}, metres",
                    f"model {indexed.label}"]  # fmt: skip

        def make() -> bytes:
            points, normals = points_of(geometry_of(self._store, self._signers, indexed).surface)
            if within == "optical":
                return write_ply(points, normals, comments=comments)
            to_name = np.array(matrix)
            turned = normals.astype(np.float64) @ to_name[:3, :3].T
            return write_ply(
                transform_points(to_name, points.astype(np.float64)), turned, comments=comments
            )

        return Output(indexed.tag("cloud", frame.id, indexed.row.name, name, matrix), make)

    def preview(
        self, map_name: str, frame_id: str, view: View = "depth", width: int = 320
    ) -> Output[bytes]:
        """Return an image of a frame as PNG; see `sceneprint.pictures`.

        Raises
        ------
        UnknownMap, UnknownFrame, NotIndexed : See `cloud`.
        DamagedBlob : If the view is `patches`, and the upload is lost.
        """
        indexed = find_indexed(self._store, map_name, frame_id)

        def make() -> bytes:
            if view == "patches":
                colours, text = patches_view(self._labels(indexed))
            else:
                surface = geometry_of(self._store, self._signers, indexed).surface
                colours, text = (depth_view if view == "depth" else normals_view)(surface)
            metadata = {"view": view, "frame": sensor_of(indexed.frame), "model": indexed.label}
            return picture(colours, width, {**metadata, **text})

        return Output(indexed.tag("preview", indexed.frame.id, view, width), make)

    def patches(self, map_name: str, frame_id: str) -> Output[FramePatches]:
        """Return the patches of a frame; see `preview` for errors."""
        indexed = find_indexed(self._store, map_name, frame_id)

        def make() -> FramePatches:
            return FramePatches(
                frame_id=indexed.frame.id,
                map=indexed.row.name,
                frame=sensor_of(indexed.frame),
                model=indexed.label,
                levels=[level_of(level) for level in self._hierarchy(indexed)[1].levels],
                validation=level_of(geometry_of(self._store, self._signers, indexed).patches),
            )

        return Output(indexed.tag("patches", indexed.frame.id, indexed.row.name), make)

    def signature(self, map_name: str, frame_id: str) -> Output[FrameSignature]:
        """Return the signature of a frame.

        Raises
        ------
        UnknownMap, UnknownFrame, NotIndexed : See `cloud`.
        DamagedSignature : If the signature is damaged; a job to sign the frame again is queued.
        """
        indexed = find_indexed(self._store, map_name, frame_id)

        def make() -> FrameSignature:
            vector, (n_patches, n_pairs) = self._signature(indexed)
            return FrameSignature(
                frame_id=indexed.frame.id,
                map=indexed.row.name,
                model=indexed.label,
                model_id=indexed.row.model_id,
                length=len(vector),
                n_patches=n_patches,
                n_pairs=n_pairs,
                base64=base64.b64encode(vector).decode(),
            )

        return Output(indexed.tag("signature", indexed.frame.id, indexed.row.name), make)

    def vector(self, map_name: str, frame_id: str, media_type: str = BYTES) -> Output[bytes]:
        """Return a signature as raw bytes or as an NPY file; see `signature` for errors."""
        indexed = find_indexed(self._store, map_name, frame_id)

        def make() -> bytes:
            vector, _ = self._signature(indexed)
            return vector if media_type == BYTES else npy_of(vector)

        return Output(indexed.tag("vector", media_type), make)

    def upload(self, map_name: str, frame_id: str) -> Output[bytes]:
        """Return the uploaded file of a frame, unchanged.

        Raises
        ------
        UnknownMap, UnknownFrame : If the map or the frame does not exist, or the frame was deleted.
        NotIndexed : If the frame is redundant, so its upload is not stored.
        DamagedBlob : If the upload is lost.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            frame = living(row, find_frame(connection, row, frame_id))
        if frame.state == FrameState.REDUNDANT:
            raise errors.NotIndexed(
                f"Frame {frame.id} is redundant, so its upload was not stored. "
                f"{frame.reason or ''} Upload it without `if_novel` to store it."
            )
        blob = frame.blob
        return Output(tag_of("upload", blob), lambda: self._store.blobs.get(blob), blob)

    def _hierarchy(self, indexed: IndexedFrame) -> tuple[Surface, Hierarchy]:
        """Return surface and hierarchy of a frame, from its upload, since stored points are
        rounded.
        """
        p = self._signers(indexed.row.model_id).model.parameters
        frame = read_stored(
            self._store.blobs.get(indexed.frame.blob), indexed.frame, self._store.decoders
        )
        surface = see(frame, p)
        return surface, hierarchy_of(surface, p, indexed.frame.id)

    def _labels(self, indexed: IndexedFrame) -> Ints32:
        """Return the label image of the finest patches; points of clouds are projected into it."""
        surface, hierarchy = self._hierarchy(indexed)
        labels = hierarchy.labels[0]
        if isinstance(surface.camera, Intrinsics):
            return labels
        drawn = geometry_of(self._store, self._signers, indexed).surface
        return project_labels(vista_of(drawn), drawn, surface.points.reshape(-1, 3), labels.ravel())

    def _signature(self, indexed: IndexedFrame) -> tuple[bytes, tuple[list[int], list[int]]]:
        number, model_id = indexed.frame.number, indexed.row.model_id
        try:
            with self._store.database.read() as connection:
                vector = stored_vector(connection, number, model_id)
                sizes = patch_counts(connection, number, model_id)
        except errors.DamagedSignature:
            resign_frames(self._store, indexed.row, [number], model_id)
            raise
        if vector is None or sizes is None:
            check_unchanged(self._store, indexed)
            raise errors.DamagedSignature(
                f"The signature of frame {indexed.frame.id} is missing. Run `sceneprint fsck`."
            )
        return vector, sizes


def placed(frame: FrameRow, within: CloudFrame) -> tuple[str, list[list[float]]]:
    """Return the name of a coordinate frame, and T_name_sensor (4, 4) of a stored frame.

    Raise InvalidRequest if the frame lacks the pose or the base that `within` requires.
    """
    optical = sensor_of(frame)
    name, matrix = {
        "optical": (optical, np.eye(4).tolist()),
        "parent": (frame.pose_parent, frame.pose),
        "base": (frame.base_frame, frame.base),
    }[within]
    if matrix is None or name is None:
        lacking = "pose" if within == "parent" else "T_base_sensor"
        raise errors.InvalidRequest(
            f"Frame {frame.id} has no {lacking}, so its points are available only in {optical}. "
            f"Use frame=optical, or add a {lacking} with PATCH.",
            (("frame", f"the frame has no {lacking}"),),
        )
    return name, matrix
