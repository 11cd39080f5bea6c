"""The measurements themselves: a missing open3d stops nothing, and memory stays bounded."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.__main__ import table
from benchmarks.encode import measure
from benchmarks.machine import peak_megabytes_of_signing
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics
from sceneprint.pipeline import Signer
from sceneprint.types import DepthFrame


def test_without_open3d_the_row_says_so_and_the_rest_runs(
    small_signer: Signer, room_frames: tuple[DepthFrame, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    figures = measure(list(room_frames[:3]), small_signer, warm_up=1)
    assert (figures.fpfh, figures.ratio, figures.fpfh_stages) == (None, None, {})
    assert figures.signing > 0
    assert len(figures.stages) == 8
    lines = "\n".join(table("small", figures, 100.0))
    assert "FPFH | not measured: " in lines
    assert "Open3D, which cannot be imported here" in lines
    assert "libgomp1" in lines  # among what Debian lacks


@pytest.mark.parametrize("preset", ["paper", "depth"])
def test_signing_stays_under_its_memory(
    preset: str, room_frames: tuple[DepthFrame, ...], tmp_path: Path
) -> None:
    """The budget is 700 MB; a process that has done its imports alone needs over 50."""
    write_intrinsics(tmp_path, Camera(room_frames[0].intrinsics))
    write_depth_png(tmp_path / "frame.png", room_frames[0].depth, 1000.0)
    assert 50 < peak_megabytes_of_signing(tmp_path, preset) < 700
