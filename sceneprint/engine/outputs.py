"""What a frame is made of, out of the store: cloud, picture, patches, signature, upload.

frame  --Outputs-->  Output: a tag that stands for the content, and how to make it
"""

from __future__ import annotations

import base64

import numpy as np

from sceneprint.clouds import points_of, write_ply
from sceneprint.engine.frames import read_stored
from sceneprint.engine.healing import sign_again
from sceneprint.engine.indexed import (
    IndexedFrame,
    check_unchanged,
    find_indexed,
    geometry_of,
    living,
)
from sceneprint.engine.made import BYTES, Output, level_of, npy_of
from sceneprint.engine.signers import Signers
from sceneprint.engine.tags import tag_of
from sceneprint.engine.wire import sensor_of
from sceneprint.errors import (
    DamagedSignature,
    InvalidRequest,
    NotIndexed,
)
from sceneprint.geometry.rigid import moved
from sceneprint.previews import depth_view, normals_view, patches_view, picture
from sceneprint.schemas import FrameState
from sceneprint.schemas.outputs import CloudFrame, FramePatches, FrameSignature, View
from sceneprint.signing import hierarchy_of, see
from sceneprint.store import Store
from sceneprint.store.frames import find_frame
from sceneprint.store.maps import find_map
from sceneprint.store.records import FrameRow
from sceneprint.store.signatures import Sizes, signature_sizes, stored_vector
from sceneprint.types import Hierarchy, Intrinsics, Ints32, Surface
from sceneprint.vistas import onto, vista_of


class Outputs:
    """What frames are made of.

    Parameters
    ----------
    store : see Store
    signers : of the store's models
    """

    def __init__(self, store: Store, signers: Signers) -> None:
        self._store, self._signers = store, signers

    def cloud(self, map_name: str, frame_id: str, within: CloudFrame = "optical") -> Output[bytes]:
        """Points and normals of a frame's surface as PLY.

        Parameters
        ----------
        map_name, frame_id : of an indexed frame
        within : the coordinates: of the camera, of the parent frame of its pose, of the robot's
            base

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it was deleted.
        NotIndexed : nothing has been made of it, or not yet.
        InvalidRequest : its pose, or where the sensor sits on its base, is not known.
        """
        found = find_indexed(self._store, map_name, frame_id)
        frame, optical = found.frame, sensor_of(found.frame)
        name, matrix = placed(frame, within)
        comments = [f"frame {name}", f"points of {optical} of map {found.row.name}, metres",
                    f"model {found.label}"]  # fmt: skip

        def make() -> bytes:
            points, normals = points_of(geometry_of(self._store, found).surface)
            if within == "optical":
                return write_ply(points, normals, comments=comments)
            to_name = np.array(matrix)
            turned = normals.astype(np.float64) @ to_name[:3, :3].T
            return write_ply(moved(to_name, points.astype(np.float64)), turned, comments=comments)

        return Output(found.tag("cloud", frame.id, found.row.name, name, matrix), make)

    def preview(
        self, map_name: str, frame_id: str, view: View = "depth", width: int = 320
    ) -> Output[bytes]:
        """A picture of a frame as PNG; see `sceneprint.previews`. Errors as of `cloud`.

        Raises
        ------
        DamagedBlob : for patches: the upload is lost.
        """
        found = find_indexed(self._store, map_name, frame_id)

        def make() -> bytes:
            if view == "patches":
                colours, text = patches_view(self._labels(found))
            else:
                surface = geometry_of(self._store, found).surface
                colours, text = (depth_view if view == "depth" else normals_view)(surface)
            told = {"view": view, "frame": sensor_of(found.frame), "model": found.label}
            return picture(colours, width, {**told, **text})

        return Output(found.tag("preview", found.frame.id, view, width), make)

    def patches(self, map_name: str, frame_id: str) -> Output[FramePatches]:
        """The patches of a frame. Errors as of `preview`."""
        found = find_indexed(self._store, map_name, frame_id)

        def make() -> FramePatches:
            return FramePatches(
                frame_id=found.frame.id,
                map=found.row.name,
                frame=sensor_of(found.frame),
                model=found.label,
                levels=[level_of(one) for one in self._hierarchy(found)[1].levels],
                validation=level_of(geometry_of(self._store, found).patches),
            )

        return Output(found.tag("patches", found.frame.id, found.row.name), make)

    def signature(self, map_name: str, frame_id: str) -> Output[FrameSignature]:
        """The signature of a frame. Errors as of `cloud`.

        Raises
        ------
        DamagedSignature : its bytes are not those that were stored; it is made again.
        """
        found = find_indexed(self._store, map_name, frame_id)

        def make() -> FrameSignature:
            vector, sizes = self._signature(found)
            return FrameSignature(
                frame_id=found.frame.id,
                map=found.row.name,
                model=found.label,
                model_id=found.row.model_id,
                length=len(vector),
                n_patches=list(sizes.n_patches),
                n_pairs=list(sizes.n_pairs),
                base64=base64.b64encode(vector).decode(),
            )

        return Output(found.tag("signature", found.frame.id, found.row.name), make)

    def vector(self, map_name: str, frame_id: str, media_type: str = BYTES) -> Output[bytes]:
        """The bytes of a signature, as they are or as an NPY file. Errors as of `signature`."""
        found = find_indexed(self._store, map_name, frame_id)

        def make() -> bytes:
            vector, _ = self._signature(found)
            return vector if media_type == BYTES else npy_of(vector)

        return Output(found.tag("vector", media_type), make)

    def upload(self, map_name: str, frame_id: str) -> Output[bytes]:
        """A frame's upload, byte for byte as it came.

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it was deleted.
        NotIndexed : it was not kept, as the map had its place.
        DamagedBlob : it is lost.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            frame = living(row, find_frame(connection, row, frame_id))
        if frame.state == FrameState.REDUNDANT:
            raise NotIndexed(
                f"Frame {frame.id} is redundant, and its upload was not kept. "
                f"{frame.reason or ''} Upload it without `if_novel` to keep it."
            )
        blob = frame.blob
        return Output(tag_of("upload", blob), lambda: self._store.blobs.get(blob), blob)

    def _hierarchy(self, found: IndexedFrame) -> tuple[Surface, Hierarchy]:
        """As it was signed: of the upload, as the artifact's points are rounded."""
        p = self._signers(found.row.model_id).model.parameters
        frame = read_stored(self._store.blobs.get(found.frame.blob), found.frame)
        seen = see(frame, p)
        return seen, hierarchy_of(seen, p, found.frame.id)

    def _labels(self, found: IndexedFrame) -> Ints32:
        """The finest patches as an image; those of a cloud are of points in no order."""
        seen, hierarchy = self._hierarchy(found)
        labels = hierarchy.labels[0]
        if isinstance(seen.camera, Intrinsics):
            return labels
        drawn = geometry_of(self._store, found).surface
        return onto(vista_of(drawn), drawn, seen.points.reshape(-1, 3), labels.ravel())

    def _signature(self, found: IndexedFrame) -> tuple[bytes, Sizes]:
        number, model_id = found.frame.number, found.row.model_id
        try:
            with self._store.database.read() as connection:
                vector = stored_vector(connection, number, model_id)
                sizes = signature_sizes(connection, number, model_id)
        except DamagedSignature:
            sign_again(self._store, found.row, [number], model_id)
            raise
        if vector is None or sizes is None:
            check_unchanged(self._store, found)
            raise DamagedSignature(
                f"The signature of frame {found.frame.id} is missing. `sceneprint fsck` says why."
            )
        return vector, sizes


def placed(frame: FrameRow, within: CloudFrame) -> tuple[str, list[list[float]]]:
    """What some coordinates of a frame are called, and the (4, 4) that leads there from its
    sensor's.

    Raises
    ------
    InvalidRequest : its pose, or where the sensor sits on its base, is not known.
    """
    optical = sensor_of(frame)
    name, matrix = {
        "optical": (optical, np.eye(4).tolist()),
        "parent": (frame.pose_parent, frame.pose),
        "base": (frame.base_frame, frame.base),
    }[within]
    if matrix is None or name is None:
        lacking = "pose" if within == "parent" else "T_base_sensor"
        raise InvalidRequest(
            f"Frame {frame.id} has no {lacking}, so its points are known in {optical} alone. "
            f"Ask for frame=optical, or give it one with PATCH.",
            (("frame", f"it has no {lacking}"),),
        )
    return name, matrix
