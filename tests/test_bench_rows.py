"""Test that signing stays within its memory, as `make bench` measures it."""

from benchmarks.machine import peak_megabytes_of_signing
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics


def test_signing_stays_under_its_memory(room_frames, tmp_path):
    """The budget is 700 MB; a process that has done its imports alone needs over 50."""
    write_intrinsics(tmp_path, Camera(room_frames[0].intrinsics))
    write_depth_png(tmp_path / "frame.png", room_frames[0].depth, 1000.0)
    assert 50 < peak_megabytes_of_signing(tmp_path, "depth") < 700
