"""Tests of filters and `--if-novel` on the command line."""

import pytest

from sceneprint.cli.options import add_filter_options, filter_of


def test_options_are_a_filter():
    import argparse

    parser = argparse.ArgumentParser()
    add_filter_options(parser)
    assert filter_of(parser.parse_args([])) is None
    values = (
        "--session s --after 2026-11-16T09:30:00Z --before 2026-11-16T10:30:00Z --not-within 4.5 "
        "--region 0,1,2,3,4.5,5 --region-frame hall --exclude f --exclude g"
    )
    assert filter_of(parser.parse_args(values.split())) == {
        "session": ["s"], "captured_after": "2026-11-16T09:30:00Z",
        "captured_before": "2026-11-16T10:30:00Z", "not_within_s": 4.5,
        "region": {"parent_frame": "hall", "min": {"x": 0, "y": 1, "z": 2},
                   "max": {"x": 3, "y": 4.5, "z": 5}},
        "exclude_frames": ["f", "g"],
    }  # fmt: skip


def test_an_upload_counts_what_was_not_kept(sceneprint, rooms):
    done = sceneprint("upload", "novel", rooms / "room-0", "--if-novel=1")
    assert done.stderr == ""  # nothing is wrong
    first = "3 frames: 3 received, 0 already there; 1 indexed, 0 rejected, 0 failed, 2 redundant; "
    assert done.stdout.splitlines()[-2].startswith(first)
    done = sceneprint("upload", "novel", rooms / "room-0", "--if-novel", "0.001")
    again = "3 frames: 2 received, 1 already there; 3 indexed, 0 rejected, 0 failed; "
    assert done.stdout.splitlines()[-2].startswith(again)


@pytest.mark.parametrize("text", ["0", "1.5", "much", "false"])
def test_a_condition_is_a_share(sceneprint, rooms, text):
    with pytest.raises(SystemExit):
        sceneprint("upload", "novel", rooms, f"--if-novel={text}")
