"""What a frame is made of, as JSON."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sceneprint.schemas.base import Told

#: In which coordinates a frame's cloud is told.
CloudFrame = Literal["optical", "parent", "base"]
CLOUD_FRAMES: tuple[CloudFrame, ...] = ("optical", "parent", "base")

#: What a picture of a frame shows.
View = Literal["depth", "normals", "patches"]
VIEWS: tuple[View, ...] = ("depth", "normals", "patches")
#: Least and most columns of a picture, and how many it has by default.
WIDTHS = (64, 1280)
WIDTH = 320

Triple = tuple[float, float, float]


class PatchLevel(Told):
    """Surface patches, a place in each list for each of them.

    Metres are rounded to a tenth of a millimetre, normals to four digits, areas to a tenth of a
    square centimetre.
    """

    mean: list[Triple] = Field(description="x, y, z in metres.")
    normal: list[Triple] = Field(description="Unit length, towards the sensor.")
    area_m2: list[float]
    size: list[int] = Field(description="Pixels of the surface map, which is about 160 x 120.")


class FramePatches(Told):
    """The patches of a frame, as its model segments it."""

    frame_id: str
    map: str
    frame: str = Field(description="Frame of the coordinates: the sensor's.")
    model: str
    levels: list[PatchLevel] = Field(
        description="The hierarchy that the signature describes, the finest first."
    )
    validation: PatchLevel = Field(description="The patches that matches are validated with.")


class FrameSignature(Told):
    """The signature of a frame."""

    frame_id: str
    map: str
    model: str
    model_id: str = Field(description="Signatures of two models are never compared.")
    dtype: Literal["uint8"] = "uint8"
    length: int = Field(description="Bytes.")
    n_patches: list[int] = Field(description="Of each level, the finest first.")
    n_pairs: list[int] = Field(description="Ordered pairs of patches of each level.")
    base64: str = Field(description="The bytes. Compare two by the sum of absolute differences.")
