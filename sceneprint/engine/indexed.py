"""An indexed frame as it was found, with what its map's model made of it."""

from __future__ import annotations

from dataclasses import dataclass

from sceneprint.artifacts import read_geometry
from sceneprint.engine.healing import sign_again
from sceneprint.engine.tags import tag_of
from sceneprint.engine.wire import model_label
from sceneprint.errors import Busy, DamagedBlob, NotIndexed, UnknownFrame, UnreadableGeometry
from sceneprint.schemas import FrameState
from sceneprint.store import Store
from sceneprint.store.frames import find_frame
from sceneprint.store.maps import find_map, model_names
from sceneprint.store.records import FrameRow, MapRow
from sceneprint.store.signatures import geometry_blobs
from sceneprint.types import Geometry

#: Of all that is made of frames: raise it when the same frame comes to give other bytes.
FORM = 1


@dataclass(frozen=True, eq=False)
class IndexedFrame:
    """A frame that has been signed.

    Parameters
    ----------
    row : its map
    frame : see FrameRow
    label : of the model
    artifact : blob of its geometry
    """

    row: MapRow
    frame: FrameRow
    label: str
    artifact: str

    def tag(self, what: str, *options: object) -> str:
        """An entity tag of something that is made of it."""
        return tag_of(what, FORM, self.frame.content_id, self.row.model_id, *options)


def find_indexed(store: Store, map_name: str, frame_id: str) -> IndexedFrame:
    """The indexed frame of an id.

    Raises
    ------
    UnknownMap, UnknownFrame : there is none, or it was deleted.
    NotIndexed : nothing has been made of it, or not yet.
    """
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        frame = living(row, find_frame(connection, row, frame_id))
        artifacts = geometry_blobs(connection, [frame.number], row.model_id)
        label = model_label(model_names(connection)[row.model_id], row.model_id)
    if frame.state != FrameState.INDEXED or frame.number not in artifacts:
        raise NotIndexed(
            f"Frame {frame.id} is {frame.state}: {frame.state.sentence} What is made of a "
            "frame can be had once it is indexed."
        )
    return IndexedFrame(row, frame, label, artifacts[frame.number])


def living(row: MapRow, frame: FrameRow) -> FrameRow:
    """The frame; UnknownFrame where it was deleted."""
    if frame.state == FrameState.DELETED:
        raise UnknownFrame(f"Frame {frame.id} of map {row.name!r} was deleted.")
    return frame


def geometry_of(store: Store, found: IndexedFrame) -> Geometry:
    """The geometry artifact of a frame; a damaged one is made again.

    Raises
    ------
    DamagedBlob, UnreadableGeometry : it is lost or damaged.
    UnknownFrame, NotIndexed, Busy : see `check_unchanged`.
    """
    try:
        return read_geometry(store.blobs.get(found.artifact))
    except (DamagedBlob, UnreadableGeometry):
        check_unchanged(store, found)
        sign_again(store, found.row, [found.frame.number], found.row.model_id)
        raise


def check_unchanged(store: Store, found: IndexedFrame) -> None:
    """See that a frame is still what it was when it was found.

    Raises
    ------
    UnknownFrame, NotIndexed : it was deleted, or lost what was made of it.
    Busy : its map came to have another model.
    """
    now = find_indexed(store, found.row.name, found.frame.id)
    if (now.frame.number, now.artifact) != (found.frame.number, found.artifact):
        raise Busy(
            f"Frame {found.frame.id} has been signed with another model meanwhile. Ask again."
        )
