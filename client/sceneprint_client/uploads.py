"""Uploads: one frame, one under an id of the caller, many at once."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sceneprint_client.api import Added, Frame, FrameMeta, FrameState
from sceneprint_client.api.base import novelty_of
from sceneprint_client.api.frames import (
    MOST_OF_BATCH,
    MOST_PRIORITY,
    Batch,
    BatchItem,
    check_frame_id,
)
from sceneprint_client.errors import InvalidRequest
from sceneprint_client.http import (
    ServiceConnection,
    frame_bytes,
    frame_form,
    frame_path,
    frames_form,
    growing_pauses,
    map_path,
    read_record,
)

if TYPE_CHECKING:
    from sceneprint_client.http import FrameInput, MetaInput

#: Longest time the service is asked to wait for a worker, seconds.
_LONGEST_WAIT_S = 60


class UploadMethods(ServiceConnection):
    """How frames come into a map."""

    def upload(
        self, map_name: str, frame: FrameInput, meta: MetaInput | None = None,
        *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None, up: Sequence[float] | None = None,
    ) -> Added:  # fmt: skip
        """Upload a frame into a map. It is durable when this returns, and signed soon after.

        Parameters
        ----------
        map_name : of the map
        frame : a path, the content of a PNG or NPY file or of a cloud, a frame of
            `find_sequences`, or an array: (H, W) depth, uint16 in stored units or floating in
            metres, or (N, 3) points; or an image or cloud of Open3D, or an image of Pillow
        meta : metadata; default: what `meta_of` finds. Or only the camera:
            CameraIntrinsics, Open3D's PinholeCameraIntrinsic, or for an array a (3, 3) matrix or
            (fx, fy, cx, cy)
        wait_s : seconds to wait until it is signed; default: none
        priority : -10 to 10; frames of higher priority are signed first
        if_novel : keep it only if its place is new to the map: its nearest frame is farther than
            this share of the distance between unrelated frames (True: 0.3);
            else the frame becomes `redundant`, and `reason` names the near frame
        up : unit vector in the sensor's axes, from an IMU; default: from `meta` or a sidecar

        Returns
        -------
        added : its state says whether it is signed yet

        Raises
        ------
        UnknownMap : no such map.
        FrameError, DatasetError : the frame cannot be read, or its camera or pose is invalid.
        FrameConflict : the map has the same content with other metadata.
        InvalidRequest : a priority or `if_novel` out of range.
        """
        until = time.monotonic() + (wait_s or 0.0)
        added, _ = self.add(
            map_name, frame, meta, wait_s=wait_s, priority=priority, if_novel=if_novel, up=up
        )  # fmt: skip
        return self._settled(map_name, added, until)

    def add(
        self, map_name: str, frame: FrameInput, meta: MetaInput | None = None,
        *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None, up: Sequence[float] | None = None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Like `upload`, with a flag: False if the map already had the frame.

        The wait may end early; `upload` waits until the end.
        """
        return self._upload(
            "POST", f"{map_path(map_name)}/frames", frame, meta, wait_s or 0.0,
            upload_fields(priority, if_novel), up,
        )  # fmt: skip

    def put_frame(
        self, map_name: str, frame_id: str, frame: FrameInput,
        meta: MetaInput | None = None, *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None, up: Sequence[float] | None = None,
    ) -> Added:  # fmt: skip
        """Upload a frame under an id of your own; sending it again has no further effect.

        Parameters
        ----------
        map_name : of the map
        frame_id : up to 64 letters, digits, dots, hyphens and underscores, the first a letter or
            digit
        frame, meta, wait_s, priority, if_novel, up : as for `upload`

        Raises
        ------
        UnknownMap, FrameError, DatasetError : as for `upload`.
        FrameConflict : that id has a frame with other content or metadata.
        InvalidRequest : an invalid id; a priority or `if_novel` out of range.
        """
        check_frame_id(frame_id)
        until = time.monotonic() + (wait_s or 0.0)
        added, _ = self._upload(
            "PUT", frame_path(map_name, frame_id), frame, meta, wait_s or 0.0,
            upload_fields(priority, if_novel), up,
        )  # fmt: skip
        return self._settled(map_name, added, until)

    def upload_batch(
        self, map_name: str, frames: Sequence[FrameInput],
        metas: Sequence[MetaInput] | FrameMeta | None = None, *, priority: int = 0,
        if_novel: float | bool | None = None,
    ) -> list[BatchItem]:  # fmt: skip
        """Upload up to 64 frames in one commit; an invalid frame does not affect the others.

        Parameters
        ----------
        map_name : of the map
        frames, metas : as for `upload`; one for all, or one for each
        priority, if_novel : for all

        Returns
        -------
        items : one for each frame, in order

        Raises
        ------
        UnknownMap : no such map.
        UnreadableFrame, DatasetError : a file cannot be read, and nothing was sent.
        InvalidRequest : too many frames, or another number of metadata.
        """
        if isinstance(metas, FrameMeta):
            metas = [metas] * len(frames)
        if not 1 <= len(frames) <= MOST_OF_BATCH or (metas and len(metas) != len(frames)):
            raise InvalidRequest(
                f"The batch has {len(frames)} frames. Give 1 to {MOST_OF_BATCH}, and one `meta` "
                "for all or for each.",
                (("frames", "too many or too few"),),
            )
        known = [None] * len(frames) if metas is None else metas
        request = frames_form(frames, known)
        request["data"] |= upload_fields(priority, if_novel)
        return self._ask(Batch, "POST", f"{map_path(map_name)}/frames/batch", **request).items

    def _upload(
        self, method: str, path: str, frame: FrameInput, meta: MetaInput | None,
        wait_s: float, fields: dict[str, str], up: Sequence[float] | None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Send a frame; the service does not wait for one it had already."""
        sent = frame_form(*frame_bytes(frame, meta, with_pose=True, up=up))
        sent["data"] |= fields
        # where this process is the worker, nobody would sign it meanwhile
        wait = 0 if self._worker is not None else min(int(wait_s), _LONGEST_WAIT_S)
        response = self._send(
            method, path, headers={"Prefer": f"wait={wait}"} if wait else {},
            timeout=self._timeout_s + wait, **sent,
        )  # fmt: skip
        return read_record(Added, response), response.status_code != 200

    def _settled(self, map_name: str, added: Added, until: float) -> Added:
        """Return an upload once its job is over, or as it is at a time of `time.monotonic`."""
        for pause in growing_pauses(until):
            if added.state not in (FrameState.RECEIVED, FrameState.SIGNING):
                break
            self._let_work(pause)
            now = self._ask(Frame, "GET", frame_path(map_name, added.frame_id))
            added = added.model_copy(update={"state": now.state, "reason": now.reason})
        return added


def upload_fields(priority: int, if_novel: float | bool | None) -> dict[str, str]:
    """Return the fields of an upload beside the frame, those with other values than the default."""
    if abs(priority) > MOST_PRIORITY:
        raise InvalidRequest(
            f"The priority is {priority}. Give one from {-MOST_PRIORITY} to {MOST_PRIORITY}.",
            (("priority", "out of its range"),),
        )
    novelty = novelty_of(if_novel)
    fields = {"priority": str(priority)} if priority else {}
    return fields if novelty is None else {**fields, "if_novel": repr(novelty)}
