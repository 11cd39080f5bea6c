"""Client methods for uploads of single frames and of batches."""

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
from sceneprint_client.calls import Call
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

#: Longest wait for a worker that one request specifies, seconds.
_LONGEST_WAIT_S = 60


class UploadMethods(ServiceConnection):
    """Client methods that add frames to a map."""

    @Call
    async def upload(
        self, map_name: str, frame: FrameInput, meta: MetaInput | None = None,
        *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None, up: Sequence[float] | None = None,
    ) -> Added:  # fmt: skip
        """Upload a frame. It is durable when this returns; a worker signs it soon after.

        Parameters
        ----------
        frame : path or content of a file, frame of `find_sequences`, or array: (H, W) depth,
            uint16 in stored units or floating point in metres, or (N, 3) points; or an image or
            cloud of Open3D, or an image of Pillow
        meta : metadata; default: those of `meta_of`. Or only the camera: CameraIntrinsics,
            Open3D's PinholeCameraIntrinsic, or for an array a (3, 3) matrix or (fx, fy, cx, cy)
        wait_s : longest wait until the frame is signed, seconds; default: no wait
        priority : -10 to 10; frames of higher priority are signed first
        if_novel : minimum distance to the nearest frame of the map, as a share of the distance
            between unrelated frames (True: 0.25). A closer frame becomes `redundant`, and `reason`
            names the nearest frame
        up : unit vector in the sensor's axes, from an IMU; default: from `meta` or a sidecar file

        Returns
        -------
        added : the upload; its state shows whether the frame is signed

        Raises
        ------
        UnknownMap : If the map does not exist.
        FrameError, DatasetError : If the frame cannot be read, or its camera or pose is invalid.
        FrameConflict : If the map has the same content with other metadata.
        InvalidRequest : If `priority` or `if_novel` is out of range.
        """
        until = time.monotonic() + (wait_s or 0.0)
        added, _ = await self.add(
            map_name, frame, meta, wait_s=wait_s, priority=priority, if_novel=if_novel, up=up
        )  # fmt: skip
        return await self._await_job(map_name, added, until)

    @Call
    async def add(
        self, map_name: str, frame: FrameInput, meta: MetaInput | None = None,
        *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None, up: Sequence[float] | None = None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Upload a frame like `upload`, and return whether it is new to the map.

        The service may end the wait early; `upload` repeats it until `wait_s` has passed.
        """
        return await self._upload(
            "POST", f"{map_path(map_name)}/frames", frame, meta, wait_s or 0.0,
            upload_fields(priority, if_novel), up,
        )  # fmt: skip

    @Call
    async def put_frame(
        self, map_name: str, frame_id: str, frame: FrameInput,
        meta: MetaInput | None = None, *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None, up: Sequence[float] | None = None,
    ) -> Added:  # fmt: skip
        """Upload a frame under your own id; return the upload. A repetition has no further effect.

        Parameters
        ----------
        frame_id : up to 64 letters, digits, dots, hyphens and underscores, starting with a letter
            or digit
        frame, meta, wait_s, priority, if_novel, up : see `upload`

        Raises
        ------
        UnknownMap, FrameError, DatasetError : See `upload`.
        FrameConflict : If a frame with this id has other content or metadata.
        InvalidRequest : If the id is invalid, or `priority` or `if_novel` is out of range.
        """
        check_frame_id(frame_id)
        until = time.monotonic() + (wait_s or 0.0)
        added, _ = await self._upload(
            "PUT", frame_path(map_name, frame_id), frame, meta, wait_s or 0.0,
            upload_fields(priority, if_novel), up,
        )  # fmt: skip
        return await self._await_job(map_name, added, until)

    @Call
    async def upload_batch(
        self, map_name: str, frames: Sequence[FrameInput],
        metas: Sequence[MetaInput] | FrameMeta | None = None, *, priority: int = 0,
        if_novel: float | bool | None = None,
    ) -> list[BatchItem]:  # fmt: skip
        """Upload up to 64 frames in one commit; an invalid frame does not affect the others.

        Parameters
        ----------
        frames, metas : see `upload`; one `meta` for all frames, or one for each
        priority, if_novel : see `upload`; for all frames

        Returns
        -------
        items : result for each frame, in order

        Raises
        ------
        UnknownMap : If the map does not exist.
        UnreadableFrame, DatasetError : If a file cannot be read; no frame has been sent.
        InvalidRequest : If there are too many frames, or the number of metadata differs.
        """
        if isinstance(metas, FrameMeta):
            metas = [metas] * len(frames)
        if not 1 <= len(frames) <= MOST_OF_BATCH or (metas and len(metas) != len(frames)):
            raise InvalidRequest(
                f"The batch has {len(frames)} frames. Pass 1 to {MOST_OF_BATCH} frames, and one "
                "`meta` for all or one for each.",
                (("frames", "too many or too few"),),
            )
        meta_list = [None] * len(frames) if metas is None else metas
        request = await self._run(frames_form, frames, meta_list)
        request["data"] |= upload_fields(priority, if_novel)
        batch = await self._call(Batch, "POST", f"{map_path(map_name)}/frames/batch", **request)
        return batch.items

    async def _upload(
        self, method: str, path: str, frame: FrameInput, meta: MetaInput | None,
        wait_s: float, fields: dict[str, str], up: Sequence[float] | None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Send a frame; return the upload, and whether the frame is new to the map."""
        form = frame_form(*await self._run(frame_bytes, frame, meta, with_pose=True, up=up))
        form["data"] |= fields
        # An embedded service has no other worker that could sign the frame during the wait.
        wait = 0 if self._worker is not None else min(int(wait_s), _LONGEST_WAIT_S)
        response = await self._send(
            method, path, headers={"Prefer": f"wait={wait}"} if wait else {},
            timeout=self._timeout_s + wait, **form,
        )  # fmt: skip
        return read_record(Added, response), response.status_code != 200

    async def _await_job(self, map_name: str, added: Added, until: float) -> Added:
        """Wait for the job of an upload until a time of `time.monotonic`, and return the upload."""
        for pause in growing_pauses(until):
            if added.state not in (FrameState.RECEIVED, FrameState.SIGNING):
                break
            await self._work_or_wait(pause)
            now = await self._call(Frame, "GET", frame_path(map_name, added.frame_id))
            added = added.model_copy(update={"state": now.state, "reason": now.reason})
        return added


def upload_fields(priority: int, if_novel: float | bool | None) -> dict[str, str]:
    """Return the non-default form fields of an upload; raise InvalidRequest if out of range."""
    if abs(priority) > MOST_PRIORITY:
        raise InvalidRequest(
            f"The priority is {priority}. Pass a value from {-MOST_PRIORITY} to {MOST_PRIORITY}.",
            (("priority", "out of range"),),
        )
    novelty = novelty_of(if_novel)
    fields = {"priority": str(priority)} if priority else {}
    return fields if novelty is None else {**fields, "if_novel": repr(novelty)}
