"""Frames chosen by their ids or by a filter, what to do with them, and deletions undone."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from sceneprint_client.api.base import ApiRecord, FrameState, Given, Label
from sceneprint_client.api.frames import MOST_TAGS
from sceneprint_client.api.listing import FrameDeletion, FrameListing

#: Frames that one request names, and that one request edits.
MOST_SELECTED = 1000
#: Frames that were not restored and are named with their reasons.
MOST_REFUSED = 100

_Ids = Annotated[list[Label], Field(min_length=1, max_length=MOST_SELECTED)]


class FrameSelection(Given):
    """Which frames of a map: by their ids, or all that pass a filter."""

    frame_ids: _Ids | None = Field(
        default=None, description="Ids that no frame has, or a deleted one, are passed over."
    )
    filter: FrameListing | None = Field(
        default=None,
        description="As for GET /frames, with at least one condition; `order` does not matter.",
    )

    @model_validator(mode="after")
    def _is_one(self) -> FrameSelection:
        if (self.frame_ids is None) == (self.filter is None):
            raise ValueError("give either `frame_ids` or `filter`")
        if self.filter is not None:
            if not self.filter.model_dump(exclude_defaults=True, exclude={"order"}):
                raise ValueError("`filter` has no condition, so it would select every frame")
            if self.filter.state == FrameState.DELETED:
                raise ValueError("deleted frames cannot be selected; restore them first")
        return self


class FramesEdit(FrameSelection):
    """What to change on the selected frames: what is left out stays, null removes."""

    session: Label | None = Field(
        default=None, description="Moves them to it. The parent frame of their poses stays."
    )
    robot: Label | None = Field(default=None, description="Who took them.")
    add_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    remove_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    after: Label | None = Field(
        default=None, description="`last_frame_id` of the call before, to go on from there."
    )

    @model_validator(mode="after")
    def _edits_something(self) -> FramesEdit:
        if not ({"session", "robot"} & self.model_fields_set or self.add_tags or self.remove_tags):
            raise ValueError("name session, robot, add_tags or remove_tags")
        return self


class FramesEdited(ApiRecord):
    """What an edit changed."""

    map: str
    frames: int = Field(description="How many this call changed; others were so already.")
    remaining: int = Field(
        description="How many are left, as a call edits at most 1000: repeat it with `after`."
    )
    last_frame_id: str | None = Field(
        default=None, description="Where frames remain: send it as `after`."
    )
    inverse: list[dict[str, Any]] = Field(
        description="Undo: send each as a body to the same path. They name the frames by their ids."
    )


class FramesDeleted(ApiRecord):
    """What a deletion did."""

    map: str
    frames: int = Field(description="How many this call deleted.")
    remaining: int = Field(description="How many are left as time was over: repeat the call.")
    deletion: FrameDeletion | None = Field(
        description="How to undo this call; null where it cannot be undone."
    )


class RestoreOptions(Given):
    """Which deleted frames to restore."""

    deletion_id: Label | None = Field(default=None, description="All frames of this deletion.")
    frame_ids: _Ids | None = Field(default=None, description="These frames.")

    @model_validator(mode="after")
    def _names_one(self) -> RestoreOptions:
        if (self.deletion_id is None) == (self.frame_ids is None):
            raise ValueError("give either `deletion_id` or `frame_ids`")
        return self


class RefusedFrame(ApiRecord):
    """A frame that was not restored."""

    frame_id: str
    reason: str


class FramesRestored(ApiRecord):
    """What became of deleted frames."""

    map: str
    frames: int = Field(
        description="How many this call restored. Workers sign again those that were indexed."
    )
    refused: list[RefusedFrame] = Field(
        description=f"Frames that were not restored, at most {MOST_REFUSED} of them: another has "
        "the id, or the same content was uploaded since."
    )
    remaining: int = Field(description="How many are left as time was over: repeat the call.")
