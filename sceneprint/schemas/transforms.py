"""Rigid transforms as JSON."""

from __future__ import annotations

from pydantic import Field

from sceneprint.schemas.base import Told


class Vector(Told):
    """Metres."""

    x: float
    y: float
    z: float


class Quaternion(Told):
    """Unit quaternion, w >= 0."""

    x: float
    y: float
    z: float
    w: float


class Transform(Told):
    """x_parent = matrix @ x_child, in metres. Camera frames (`ID.optical`): x right, y down, z
    ahead; a cloud (`ID.sensor`) keeps the axes of its sensor.
    """

    parent_frame: str
    child_frame: str
    translation: Vector
    rotation: Quaternion
    matrix: list[list[float]] = Field(description="4 x 4, row by row.")
