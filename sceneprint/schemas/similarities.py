"""Two frames compared, as JSON."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sceneprint.schemas.base import Given, Told
from sceneprint.schemas.maps import Preset
from sceneprint.schemas.matches import Uncertainty, Validation
from sceneprint.schemas.options import FrameName, JsonText, NamedFrame, ValidationOptions
from sceneprint.schemas.transforms import Transform


class Comparison(Given):
    """Which frames to compare, and how."""

    frame_a: Annotated[NamedFrame | None, JsonText] = Field(
        default=None, description="A stored frame, in place of an upload `a`."
    )
    frame_b: Annotated[NamedFrame | None, JsonText] = Field(
        default=None, description="A stored frame, in place of an upload `b`."
    )
    aligned: bool = Field(
        default=True,
        alias="validate",
        description="Align them, and say whether they see one place.",
    )
    validation: Annotated[ValidationOptions | None, JsonText] = Field(
        default=None, description="What the alignment must stand to be accepted."
    )
    seed: int = Field(
        default=0, ge=0, lt=2**32, description="Of the random choices; the answer echoes it."
    )
    model: Preset | None = Field(
        default=None,
        description="That signs two uploads; default: `depth`; of a LiDAR, `lidar`. A stored frame "
        "brings its own.",
    )


class Similarity(Told):
    """How alike two frames are."""

    distance: int = Field(
        description="Of their signatures: squared L2, or L1 where psi itself is stored."
    )
    similarity: float = Field(description="1 - distance / that of unrelated frames, 0 to 1.")
    model: str
    a: FrameName | None = Field(description="The stored frame; null for an upload.")
    b: FrameName | None
    validation: Validation | None = Field(description="Null where it was not asked for.")
    transform: Transform | None = Field(
        description="x_a = matrix @ x_b; believe it where the validation accepts it."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Of `transform`, where the validation accepts it."
    )
    seed: int
    milliseconds: dict[str, float] = Field(
        description="`prepare` (both frames), `validate`, `total`."
    )
