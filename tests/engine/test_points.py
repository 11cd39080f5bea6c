"""Tests of points for pages, with residuals like those of an overlay."""

import numpy as np
import pytest

from sceneprint.errors import InvalidRequest, NotIndexed, UnknownFrame
from sceneprint.formats.export import points_of
from sceneprint.geometry.rigid import transform_points
from sceneprint.geometry.validation.inspection import patches_at
from sceneprint_client.api import Query
from sceneprint_client.surface_encoding import HEADER, POINT


def rows_of(data):
    """Header, rows, and their positions in metres."""
    head = HEADER.unpack_from(data)
    rows = np.frombuffer(data, POINT, offset=HEADER.size)
    return head, rows, np.array(head[5:8]) + rows["position"] / 65535 * np.array(head[8:11])


@pytest.fixture
def asked(full, ids):
    return full.query_frame("hall", ids(full)[3], Query(k=2, seed=5))


def test_the_points_of_a_frame(full, prepared, ids):
    geometry = prepared[3][1]
    points, normals = points_of(geometry.surface)
    whole = full.points.frame("hall", ids(full)[3])
    head, rows, at = rows_of(whole.make())
    assert (head[2], head[3], head[11], head[12]) == (3, len(points), len(points), 0)
    assert at == pytest.approx(points, abs=1e-4)
    assert rows["normal"] / 127 == pytest.approx(normals, abs=0.5 / 127 + 1e-6)
    found = patches_at(np.hstack([points, normals]), geometry.patches)
    assert (rows["patch"] == np.where(found < 0, 65535, found)).all()
    assert len(set(found.tolist())) > 0.9 * len(geometry.patches)
    assert (rows["residual"] == 255).all()
    fewer = full.points.frame("hall", ids(full)[3], limit=100)
    assert rows_of(fewer.make())[0][3] == 100
    assert rows_of(fewer.make())[0][11] == len(points)
    assert fewer.tag != whole.tag
    with pytest.raises(InvalidRequest, match="no T_base_sensor"):
        full.points.frame("hall", ids(full)[3], "base")
    pose = np.array(full.get_frame("hall", ids(full)[3]).pose.matrix)
    _, _, there = rows_of(full.points.frame("hall", ids(full)[3], "parent").make())
    assert there == pytest.approx(transform_points(pose, points.astype(float)), abs=1e-4)


def test_what_cannot_be_drawn(full, asked, ids):
    best = asked.matches[0].frame_id
    with pytest.raises(InvalidRequest, match="no rival"):
        full.points.match(asked.query_id, best, by="rival").make()
    bare = full.query_frame("hall", ids(full)[3], Query(k=1, stages=("retrieve",)))
    with pytest.raises(NotIndexed):
        full.points.query(bare.query_id)
    full.delete_frame("hall", best)
    with pytest.raises(UnknownFrame, match="was deleted"):
        full.points.match(asked.query_id, best)
