import hashlib
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.types import Intrinsics
from sceneprint_lab.synth import synthesise_room

SMALL = Intrinsics(160, 120, 146.25, 146.25, 80.0, 60.0)


def digest(room):
    h = hashlib.sha256()
    for frame in room.frames:
        h.update(frame.depth.tobytes() + frame.pose.tobytes() + frame.name.encode())
    return h.hexdigest()


def test_the_same_seed_gives_the_same_bytes_in_any_process():
    here = digest(synthesise_room(11, 4, 3, intrinsics=SMALL))
    assert digest(synthesise_room(11, 4, 3, intrinsics=SMALL)) == here
    assert digest(synthesise_room(11, 5, 3, intrinsics=SMALL)) != here
    code = (
        "import importlib.util as u, sys\n"
        f"s = u.spec_from_file_location('t', {__file__!r}); t = u.module_from_spec(s)\n"
        "s.loader.exec_module(t)\n"
        "print(t.digest(t.synthesise_room(11, 4, 3, intrinsics=t.SMALL)))"
    )
    there = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )
    assert there.stdout.strip() == here


@pytest.mark.parametrize("index", range(2))
def test_frames_are_whole_and_mostly_valid(index):
    room = synthesise_room(3, index, 4)
    assert (room.name, len(room.frames)) == (f"room-{index:03d}", 4)
    for k, frame in enumerate(room.frames):
        assert frame.name == f"room-{index:03d}/frame-{k:06d}"
        assert (frame.depth.dtype, frame.depth.shape) == (np.float32, (480, 640))
        valid = frame.depth > 0
        assert valid.mean() > 0.40
        assert frame.depth[valid].min() >= 0.449
        assert frame.depth.max() <= 8.001
        np.testing.assert_allclose(frame.depth * 1000, (frame.depth * 1000).round(), atol=1e-3)
