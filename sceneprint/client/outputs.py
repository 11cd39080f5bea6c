"""Frames out of the service, and what is edited of them.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Protocol

from sceneprint.client.browsing import Browsing, BrowsingBackend, EmbeddedBrowsing, RemoteBrowsing
from sceneprint.client.edits import Edits, EditsBackend, EmbeddedEdits, RemoteEdits
from sceneprint.client.messages import frame_path
from sceneprint.errors import InvalidRequest
from sceneprint.schemas.outputs import (
    CLOUD_FRAMES,
    VIEWS,
    WIDTH,
    WIDTHS,
    CloudFrame,
    FramePatches,
    FrameSignature,
    View,
)

if TYPE_CHECKING:
    from sceneprint.engine import Engine


class OutputsBackend(BrowsingBackend, EditsBackend, Protocol):
    """What this topic needs of whoever does the work."""

    def cloud(self, map_name: str, frame_id: str, within: CloudFrame) -> bytes:
        """A frame's surface as PLY."""

    def preview(self, map_name: str, frame_id: str, view: View, width: int) -> bytes:
        """A picture of a frame as PNG."""

    def patches(self, map_name: str, frame_id: str) -> FramePatches:
        """A frame's patches."""

    def signature(self, map_name: str, frame_id: str) -> FrameSignature:
        """A frame's signature."""

    def upload_of(self, map_name: str, frame_id: str) -> bytes:
        """A frame's upload as it came."""


class RemoteOutputs(RemoteBrowsing, RemoteEdits):
    """Over HTTP."""

    def cloud(self, map_name: str, frame_id: str, within: CloudFrame) -> bytes:
        """A frame's surface as PLY."""
        path = f"{frame_path(map_name, frame_id)}/cloud.ply"
        return self._bytes("GET", path, params={"frame": within})

    def preview(self, map_name: str, frame_id: str, view: View, width: int) -> bytes:
        """A picture of a frame as PNG."""
        path = f"{frame_path(map_name, frame_id)}/preview.png"
        return self._bytes("GET", path, params={"view": view, "width": width})

    def patches(self, map_name: str, frame_id: str) -> FramePatches:
        """A frame's patches."""
        return self._ask(FramePatches, "GET", f"{frame_path(map_name, frame_id)}/patches")

    def signature(self, map_name: str, frame_id: str) -> FrameSignature:
        """A frame's signature."""
        return self._ask(FrameSignature, "GET", f"{frame_path(map_name, frame_id)}/signature")

    def upload_of(self, map_name: str, frame_id: str) -> bytes:
        """A frame's upload as it came."""
        return self._bytes("GET", f"{frame_path(map_name, frame_id)}/upload")


class EmbeddedOutputs(EmbeddedBrowsing, EmbeddedEdits):
    """In this process."""

    _engine: Engine

    def cloud(self, map_name: str, frame_id: str, within: CloudFrame) -> bytes:
        """A frame's surface as PLY."""
        return self._engine.outputs.cloud(map_name, frame_id, within).make()

    def preview(self, map_name: str, frame_id: str, view: View, width: int) -> bytes:
        """A picture of a frame as PNG."""
        return self._engine.outputs.preview(map_name, frame_id, view, width).make()

    def patches(self, map_name: str, frame_id: str) -> FramePatches:
        """A frame's patches."""
        return self._engine.outputs.patches(map_name, frame_id).make()

    def signature(self, map_name: str, frame_id: str) -> FrameSignature:
        """A frame's signature."""
        return self._engine.outputs.signature(map_name, frame_id).make()

    def upload_of(self, map_name: str, frame_id: str) -> bytes:
        """A frame's upload as it came."""
        return self._engine.outputs.upload(map_name, frame_id).make()


class Outputs(Browsing, Edits):
    """The calls."""

    _backend: OutputsBackend

    def cloud(self, map_name: str, frame_id: str, within: CloudFrame = "optical") -> bytes:
        """The surface that a frame saw, points and normals as PLY.

        Parameters
        ----------
        map_name, frame_id : of an indexed frame
        within : its coordinates: "optical" of the sensor, "parent" of its pose, "base" of the
            robot

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it was deleted.
        NotIndexed : nothing has been made of it, or not yet.
        InvalidRequest : it has no pose, or no base.
        """
        if within not in CLOUD_FRAMES:
            raise _unknown("frame", within, CLOUD_FRAMES)
        return self._backend.cloud(map_name, frame_id, within)

    def preview(
        self, map_name: str, frame_id: str, view: View = "depth", width: int = WIDTH
    ) -> bytes:
        """A picture of an indexed frame as PNG: "depth", "normals" or "patches". Errors as of
        `cloud`.
        """
        if view not in VIEWS:
            raise _unknown("view", view, VIEWS)
        if not WIDTHS[0] <= width <= WIDTHS[1]:
            raise InvalidRequest(
                f"The width is {width}. Give one from {WIDTHS[0]} to {WIDTHS[1]}.",
                (("width", "out of its range"),),
            )
        return self._backend.preview(map_name, frame_id, view, width)

    def patches(self, map_name: str, frame_id: str) -> FramePatches:
        """The surface patches of an indexed frame. Errors as of `cloud`."""
        return self._backend.patches(map_name, frame_id)

    def signature(self, map_name: str, frame_id: str) -> FrameSignature:
        """The signature of an indexed frame. Errors as of `cloud`."""
        return self._backend.signature(map_name, frame_id)

    def upload_of(self, map_name: str, frame_id: str) -> bytes:
        """A frame's upload, byte for byte as it came.

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it was deleted.
        NotIndexed : it was not kept.
        """
        return self._backend.upload_of(map_name, frame_id)


def _unknown(what: str, name: str, known: Iterable[str]) -> InvalidRequest:
    return InvalidRequest(
        f"There is no {what} {name!r:.40}. Give one of {', '.join(known)}.", ((what, "unknown"),)
    )
