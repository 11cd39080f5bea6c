"""Metadata of frames and maps, edited.

A part of the topic of outputs: what it needs of a backend, both backends, and the calls.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from pydantic_core import to_json

from sceneprint.client.messages import frame_path, map_path
from sceneprint.client.sending import Sender
from sceneprint.schemas import Frame, Map

if TYPE_CHECKING:
    from sceneprint.engine import Engine


class EditsBackend(Protocol):
    """What this topic needs of whoever does the work."""

    def edit_frame(
        self, map_name: str, frame_id: str, changes: Mapping[str, Any], if_match: str | None
    ) -> Frame:
        """Change the metadata of a frame."""

    def edit_map(
        self, map_name: str, changes: Mapping[str, Any], if_match: str | None, *, dry_run: bool
    ) -> Map:
        """Change title, quotas and retention of a map."""


class RemoteEdits(Sender):
    """Over HTTP."""

    def edit_frame(
        self, map_name: str, frame_id: str, changes: Mapping[str, Any], if_match: str | None
    ) -> Frame:
        """Change the metadata of a frame."""
        return self._ask(Frame, "PATCH", frame_path(map_name, frame_id), **_edit(changes, if_match))

    def edit_map(
        self, map_name: str, changes: Mapping[str, Any], if_match: str | None, *, dry_run: bool
    ) -> Map:
        """Change title, quotas and retention of a map."""
        asked = {"params": {"dry_run": "true"}} if dry_run else {}
        return self._ask(Map, "PATCH", map_path(map_name), **_edit(changes, if_match), **asked)


class EmbeddedEdits:
    """In this process."""

    _engine: Engine

    def edit_frame(
        self, map_name: str, frame_id: str, changes: Mapping[str, Any], if_match: str | None
    ) -> Frame:
        """Change the metadata of a frame."""
        from sceneprint.engine.edits import edit_frame

        tags = None if if_match is None else (if_match,)
        return edit_frame(self._engine.store, map_name, frame_id, changes, tags)

    def edit_map(
        self, map_name: str, changes: Mapping[str, Any], if_match: str | None, *, dry_run: bool
    ) -> Map:
        """Change title, quotas and retention of a map."""
        from sceneprint.engine.edits import edit_map

        tags = None if if_match is None else (if_match,)
        return edit_map(self._engine.store, map_name, changes, tags, dry_run=dry_run)


class Edits:
    """The calls."""

    _backend: EditsBackend

    def edit_frame(
        self, map_name: str, frame_id: str, changes: Mapping[str, Any],
        if_match: str | None = None,
    ) -> Frame:  # fmt: skip
        """Change the metadata of a frame; filters see it at once.

        Parameters
        ----------
        map_name, frame_id : of the frame
        changes : as JSON has them, see FrameEdit: what is left out stays, None removes
        if_match : `etag` of the frame as it was read; None to overwrite whatever came since

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it was deleted.
        InvalidRequest, InvalidPose : a field is unknown, no metadata, or not as it should be.
        PreconditionFailed : it has been edited since.
        """
        return self._backend.edit_frame(map_name, frame_id, changes, if_match)

    def edit_map(
        self, map_name: str, changes: Mapping[str, Any], if_match: str | None = None, *,
        dry_run: bool = False,
    ) -> Map:  # fmt: skip
        """Change title, quotas and retention of a map; parameters and errors as of `edit_frame`.

        Quotas are the operator's: they ask for a key with `admin` for `*`, else Forbidden. With
        `dry_run` nothing is changed, and the map told as it would be: `overdue` is how many frames
        its retention would delete at once.
        """
        return self._backend.edit_map(map_name, changes, if_match, dry_run=dry_run)


def _edit(changes: Mapping[str, Any], if_match: str | None) -> dict[str, Any]:
    """Arguments of a request that edits."""
    headers = {"Content-Type": "application/merge-patch+json"}
    if if_match is not None:
        headers["If-Match"] = f'"{if_match}"'
    return {"content": to_json(dict(changes)), "headers": headers}
