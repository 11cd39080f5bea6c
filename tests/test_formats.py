"""Tests of the table of file formats against files, and of its copies."""

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from sceneprint.decoders.child_process import array_samples, text_samples
from sceneprint.errors import FrameError
from sceneprint.formats.depth_file import decode_samples, encode_npy, encode_png, size_of
from sceneprint.formats.points.cloud import decode_scan
from sceneprint_client.formats import (
    FORMATS,
    CloudFormat,
    format_at,
    format_of,
    formats_of,
    function_at,
)

ROOT = Path(__file__).parents[1]
PNG = encode_png(np.ones((2, 3), np.uint16))
DEPTH = {
    "png": PNG,
    "npy": encode_npy(np.ones((2, 3), np.uint16)),
    "pfm": b"Pf\n3 2\n-1.0\n" + bytes(24),
    "compresseddepth": bytes(12) + PNG,
}


def test_a_name_stands_once_in_its_kind_and_functions_are_there():
    keys = [(file_format.kind, file_format.name) for file_format in FORMATS]
    assert len(set(keys)) == len(keys)
    assert {file_format.name for file_format in formats_of("cloud")} == set(get_args(CloudFormat))
    for file_format in FORMATS:
        for place in filter(None, (file_format.reader, file_format.size)):
            assert callable(function_at(place))
        assert (file_format.kind in ("depth", "cloud")) <= bool(file_format.reader)


def test_every_depth_format_is_recognised_measured_and_read():
    assert set(DEPTH) == {file_format.name for file_format in formats_of("depth")}
    for name, data in DEPTH.items():
        result = format_at(data, "depth", "map", "archive", "recording", "capture")
        assert result.name == name
        assert size_of(data) == (3, 2)
        assert decode_samples(data).shape == (2, 3)


def test_every_cloud_format_but_one_is_recognised():
    for data, name in (*array_samples(), *text_samples()):
        assert format_of(data) == (None if name == "kitti" else name)


@pytest.mark.parametrize(
    ("start", "remedy"),
    [
        (b"version https://git-lfs.github.com/spec/v1", "Run `git lfs pull`"),
        (b"\x1f\x8b\x08", "Decompress it"), (b"PK\x03\x04", "Extract it"),
        (b"<!DOCTYPE html>", "Download the file itself"),
    ],
)  # fmt: skip
def test_files_that_are_sent_by_mistake_are_named(start, remedy):
    for decode in (decode_samples, decode_scan):
        with pytest.raises(FrameError, match=remedy):
            decode(start + bytes(99))
