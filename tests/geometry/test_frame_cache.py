"""Tests that results of one frame are computed once, and dropped with the frame."""

import gc
import weakref

from sceneprint.geometry.kernel import cached_per_frame
from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    PlaneParameters,
    overlap_target,
    plane_view,
    sample_points,
)
from sceneprint.geometry.validation.acceptance import AmbiguityParameters, symmetries
from sceneprint.pipeline import open_signer, prepare


class Frame:
    """Anything that a weak reference can be had of."""


def test_a_frame_is_worked_out_once_for_each_of_the_other_arguments():
    calls = []

    @cached_per_frame
    def squared(frame, n, *, less=0):
        calls.append((n, less))
        return [n * n - less]

    one, other = Frame(), Frame()
    assert squared(one, 3) is squared(one, 3)
    assert squared(one, 4) == [16]
    assert squared(one, 3, less=1) == [8]
    assert squared(other, 3) == [9]
    assert squared(other, 3) is not squared(one, 3)
    assert calls == [(3, 0), (4, 0), (3, 1), (3, 0)]
    assert squared.__name__ == "squared"
    gone = weakref.ref(one)
    del one
    gc.collect()
    assert gone() is None


def test_nothing_of_a_frame_is_kept_when_it_is_gone(room_frames):
    """No result may hold the frame that it is kept with."""
    geometry = prepare(room_frames[0], open_signer("depth"))[1]
    references = (
        sample_points(geometry.surface, 5),
        overlap_target(geometry.surface, OverlapParameters()).points,
        plane_view(geometry, PlaneParameters()).weights,
        symmetries(geometry.patches, AmbiguityParameters()),
    )
    parts = [weakref.ref(one) for one in (geometry, geometry.surface, geometry.patches)]
    del geometry
    gc.collect()
    assert [part() for part in parts] == [None, None, None]
    assert all(len(reference) for reference in references)
