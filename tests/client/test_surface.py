"""Tests of the surface of a map by client and HTTP."""

import io

import httpx
import numpy as np
import pytest
from PIL import Image

from sceneprint.errors import InvalidRequest, NotFound, UnknownMap
from sceneprint_client.api import JobState
from sceneprint_client.surface_encoding import decode_tile

MAP, PLAIN = "produced", "poseless"
PATH = f"/v1/maps/{MAP}/surface"


@pytest.fixture(scope="module")
def fused(produced, walk):
    produced.create_map(PLAIN, model="depth")
    [(data, meta)] = walk(1)
    plain = produced.upload(PLAIN, data, meta.model_copy(update={"pose": None}))
    assert [job.state for job in produced.wait([plain.job_id])] == [JobState.SUCCEEDED]
    before = produced.surface(MAP)
    assert (before.state, before.frames, before.frames_left) == ("none", 0, 4)
    begun = produced.begin_surface(MAP)
    assert begun.job_id is not None
    assert [job.state for job in produced.wait([begun.job_id])] == [JobState.SUCCEEDED]
    return produced


def test_tiles_and_the_frames_that_saw_them(fused):
    surface = fused.surface(MAP)
    assert (surface.state, surface.frames, surface.sessions) == ("ready", 4, ["a", "b"])
    assert fused.begin_surface(MAP) == surface  # there is nothing to do
    (parent,) = surface.parents
    cells, sessions = 0, set()
    for level in parent.levels:
        tiles = list(fused.surface_tiles(MAP, "room", level.level))
        assert (len(tiles), sum(tile.bytes for tile in tiles)) == (level.tiles, level.bytes)
        for tile in tiles:
            result = decode_tile(fused.surface_tile(MAP, tile.digest), tile, level.tile_m)
            place = [tile.column, tile.row, tile.floor]
            assert (np.floor(result.points / level.tile_m) == place).all()
            sessions.update(result.sessions.tolist())
            cells += len(result.points)
    assert cells == sum(level.cells for level in parent.levels)
    assert sessions == {0, 1}
    spot = result.points[0].tolist()  # of the coarsest level: near what was seen
    assert list(fused.surface_frames(MAP, spot, radius=1.0))
    every = [-100.0, -100.0, -100.0, 100.0, 100.0, 100.0]
    boxed = list(fused.surface_frames(MAP, box=every, parent="room"))
    assert {frame.frame_id for frame in boxed} == {frame.frame_id for frame in fused.frames(MAP)}


def test_what_a_surface_refuses(fused):
    for call in (fused.surface, fused.begin_surface, fused.delete_surface, fused.surface_plan):
        with pytest.raises(UnknownMap):
            call("nowhere")
    with pytest.raises(InvalidRequest):
        fused.begin_surface(PLAIN)
    for name in ("../x", "0" * 32):
        with pytest.raises(NotFound):
            fused.surface_tile(MAP, name)
    with pytest.raises(InvalidRequest, match="Specify either `at` or `box`"):
        list(fused.surface_frames(MAP))


def test_a_tile_is_kept_for_ever_and_a_plan_asked_for_again(fused, service_url):
    tile = next(fused.surface_tiles(MAP))
    with httpx.Client(base_url=service_url) as http:
        first = http.get(f"{PATH}/tiles/{tile.digest}")
        assert first.headers["cache-control"] == "private, max-age=31536000, immutable"
        plan = http.get(f"{PATH}/plan.png")
        assert plan.headers["cache-control"] == "private, no-cache"
        for path, known in ((f"tiles/{tile.digest}", first), ("plan.png", plan)):
            again = {"If-None-Match": known.headers["etag"]}
            assert http.get(f"{PATH}/{path}", headers=again).status_code == 304
        for query in ("at=1,2", "at=1,2,nan", "at=1,2,1e300", "box=1,2,3",
                      "at=1,2,3&box=1,2,3,4,5,6", "at=1,2,3&radius=9",
                      "at=1,2,3&cursor=x"):  # fmt: skip
            assert http.get(f"{PATH}/frames?{query}").status_code == 422, query
    image = Image.open(io.BytesIO(plan.content))
    (parent,) = fused.surface(MAP).parents
    assert (image.mode, image.size) == ("RGBA", (parent.plan.width, parent.plan.height))
