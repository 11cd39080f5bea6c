"""The fused surface of a map: begun, read by tile, looked into, drawn."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sceneprint_client.api import Page
from sceneprint_client.api.surface import (
    PLAN_WIDTH,
    PLAN_WIDTHS,
    MapSurface,
    SurfaceSighting,
    SurfaceTile,
)
from sceneprint_client.errors import InvalidRequest
from sceneprint_client.http import ServiceConnection
from sceneprint_client.requests import given, surface_path, surface_tile_path


class SurfaceMethods(ServiceConnection):
    """Surfaces of maps."""

    def surface(self, map_name: str) -> MapSurface:
        """What the posed frames of a map saw, fused, as it is now; UnknownMap."""
        return self._ask(MapSurface, "GET", surface_path(map_name))

    def begin_surface(self, map_name: str) -> MapSurface:
        """Have the surface of a map built, or what came since added, now.

        Workers do so by themselves, unless they are told to wait until they are asked.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : it has no indexed frame with a pose.
        """
        return self._ask(MapSurface, "POST", surface_path(map_name))

    def delete_surface(self, map_name: str) -> None:
        """Remove the surface of a map until somebody asks for it again; UnknownMap."""
        self._delete(surface_path(map_name))

    def surface_tiles(
        self, map_name: str, parent: str | None = None, level: int = 0
    ) -> Iterator[SurfaceTile]:
        """Tiles of a level by column, row and floor; `surface` tells which levels there are.

        Parameters
        ----------
        map_name : of the map
        parent : parent frame; default: the one of most frames
        level : 0 for the finest

        Raises
        ------
        UnknownMap : no such map.
        """
        path = f"{surface_path(map_name)}/tiles"
        return self._items(Page[SurfaceTile], path, parent=parent, level=level)

    def surface_tile(self, map_name: str, digest: str) -> bytes:
        """The cells of a tile; `sceneprint_client.surface_tiles.decode_tile` reads them.

        Raises
        ------
        UnknownMap : no such map.
        NotFound : it changed since, or was removed: list the tiles again.
        """
        return self._bytes(surface_tile_path(map_name, digest))

    def surface_frames(
        self, map_name: str, at: Sequence[float] | None = None, *, radius: float | None = None,
        box: Sequence[float] | None = None, parent: str | None = None,
    ) -> Iterator[SurfaceSighting]:  # fmt: skip
        """Frames that saw a spot, from the nearest viewpoint on; or those taken in a box.

        Parameters
        ----------
        map_name : of the map
        at : x, y, z of the spot, metres
        radius : how near to it they must have seen something, metres; default: two cells
        box : x, y, z of two corners, metres; instead of `at`
        parent : parent frame; default: the one of most frames

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : neither or both of `at` and `box`, or numbers out of their range.
        """
        asked: dict[str, Any] = given(
            at=None if at is None else ",".join(map(repr, map(float, at))),
            box=None if box is None else ",".join(map(repr, map(float, box))),
            radius=radius, parent=parent,
        )  # fmt: skip
        return self._items(Page[SurfaceSighting], f"{surface_path(map_name)}/frames", **asked)

    def surface_plan(
        self, map_name: str, parent: str | None = None, *, width: int = PLAN_WIDTH,
        low: float | None = None, high: float | None = None,
    ) -> bytes:  # fmt: skip
        """A surface seen from above as a PNG file, transparent where nothing is.

        Parameters
        ----------
        map_name : of the map
        parent : parent frame; default: the one of most frames
        width : of the longer side, pixels
        low, high : only what lies between these heights, metres along up

        Raises
        ------
        UnknownMap : no such map.
        NotFound : there is no surface in that parent frame.
        """
        if not PLAN_WIDTHS[0] <= width <= PLAN_WIDTHS[1]:
            raise InvalidRequest(
                f"The width is {width}. Give one from {PLAN_WIDTHS[0]} to {PLAN_WIDTHS[1]}.",
                (("width", "out of its range"),),
            )
        asked = given(parent=parent, width=width, low=low, high=high)
        return self._bytes(f"{surface_path(map_name)}/plan.png", params=asked)
