import numpy as np

from sceneprint.types import Intrinsics
from sceneprint_lab.synth import Caster, cast_depth
from sceneprint_lab.synth.mesh import mesh_of
from sceneprint_lab.synth.trajectories import pose

SMALL = Intrinsics(24, 18, 20.0, 21.0, 11.3, 8.9)


def test_a_plane_has_its_analytic_depth_and_incidence():
    plane = mesh_of(
        [(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)], [(0, 1, 2), (0, 2, 3)]
    )
    pitch = np.radians(-60)
    T = pose(np.array([0.3, -0.2, 1.5, 0.4, pitch, 0.0]))
    depth, cosine = cast_depth(Caster(plane), T, SMALL)
    y = (np.arange(18) - SMALL.cy)[:, None] / SMALL.fy
    x = (np.arange(24) - SMALL.cx) / SMALL.fx
    fall = np.sin(-pitch) + y * np.cos(pitch) + 0 * x  # metres lower a metre of depth
    np.testing.assert_allclose(depth, 1.5 / fall, rtol=1e-5)
    np.testing.assert_allclose(cosine, fall / np.sqrt(1 + x**2 + y**2), rtol=1e-4)
