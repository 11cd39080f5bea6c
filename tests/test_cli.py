"""Tests of commands as processes: output, files and exit codes."""

import hashlib
import io
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sceneprint import cli
from sceneprint.cli.upload import Tally, summary_of
from sceneprint.formats.dataset import find_sequences
from sceneprint.models import save_model
from sceneprint.pipeline import sign
from sceneprint.types import Cloud
from sceneprint_lab.synth import synthesise_survey
from tests.conftest import Said

CAMERA = {"width": 160, "height": 120, "fx": 146, "fy": 146, "cx": 80, "cy": 60}


def run(*arguments, expect=0):
    """Run a command in this process: to start one takes longer than most commands."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as errors:
        try:
            code = cli.main([str(argument) for argument in arguments])
        except SystemExit as end:  # of argparse
            code = end.code
    said = Said(out.getvalue(), errors.getvalue())
    assert code == expect, said
    return said


def run_process(*arguments, expect=0):
    """Run a command as a shell does."""
    done = subprocess.run(
        [sys.executable, "-m", "sceneprint", *map(str, arguments)], capture_output=True, text=True
    )
    assert done.returncode == expect, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return Said(done.stdout, done.stderr)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    out = tmp_path_factory.mktemp("synth") / "rooms"
    done = run("synth", out, "--rooms", 2, "--views", 2, "--seed", 5, "--jobs", 1)
    assert "2 rooms of 2 views" in done.stdout
    return out


@pytest.fixture
def model_file(small_model, tmp_path):
    path = tmp_path / "small.safetensors"
    save_model(small_model, path)
    return path


@pytest.fixture
def frames(tmp_path):
    """A folder with one frame that can be signed, and its samples."""
    folder = tmp_path / "frames"
    folder.mkdir()
    (folder / "intrinsics.json").write_text(json.dumps(CAMERA))
    y, x = np.mgrid[:120, :160]
    good = np.where(x < 80, 1500 + 3 * y, 2500 - 4 * y).astype(np.uint16)
    Image.fromarray(good).save(folder / "a.png")
    return folder, good


def tree_hash(folder):
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


@pytest.mark.thorough
def test_synth_writes_the_layout(rooms, tmp_path):
    suffixes = ("0.depth.png", "0.pose.txt", "1.depth.png", "1.pose.txt")
    names = ["intrinsics.json", *(f"seq-01/frame-00000{suffix}" for suffix in suffixes)]
    assert list(tree_hash(rooms)) == [f"room-00{r}/{name}" for r in range(2) for name in names]
    run("synth", tmp_path / "again", "--rooms", 2, "--views", 2, "--seed", 5, "--jobs", 2)
    assert tree_hash(tmp_path / "again") == tree_hash(rooms)


def test_synth_does_not_mix_two_runs(rooms):
    before = tree_hash(rooms)
    done = run("synth", rooms, "--rooms", 1, expect=2)
    assert "is not empty" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert tree_hash(rooms) == before


def test_sign_says_a_line_and_writes_a_file_for_each_frame(
    rooms, model_file, small_signer, tmp_path
):
    out = tmp_path / "out"
    done = run_process("sign", rooms, "--model", model_file, "--out", out)
    lines = done.stdout.splitlines()
    assert len(lines) == 4
    for line in lines:
        assert small_signer.model.label in line
    assert "4 of 4 frames signed" in done.stderr
    index = json.loads((out / "signatures.json").read_text())
    assert index["model"]["id"] == small_signer.model.id
    frames = [r for s in find_sequences(rooms) for r in s.frames]
    assert [entry["name"] for entry in index["frames"]] == [f.name for f in frames]
    for entry, reference in zip(index["frames"], frames, strict=True):
        stored = (out / entry["file"]).read_bytes()
        assert stored == sign(reference.read(), small_signer).vector.tobytes()
        assert hashlib.sha256(stored).hexdigest() == entry["sha256"]
        assert len(entry["patches"]) == len(entry["pairs"]) == 2
    assert sorted(tree_hash(out)) == sorted(
        ["signatures.json", *(entry["file"] for entry in index["frames"])]
    )


def test_a_bad_frame_does_not_stop_the_others(frames, model_file, tmp_path):
    folder, good = frames
    Image.fromarray(good.astype(np.uint8)).save(folder / "b.png")
    Image.fromarray(np.zeros_like(good)).save(folder / "c.png")
    (folder / "d.png").write_bytes((folder / "a.png").read_bytes()[:200])
    np.save(folder / "e.npy", (good / 1000).astype(np.float32))
    out = tmp_path / "out"
    done = run("sign", folder, "--model", model_file, "--out", out, expect=2)
    lines = done.stdout.splitlines()
    assert ["NOT SIGNED" in line for line in lines] == [False, True, True, True, False]
    assert "2 of 5 frames signed" in done.stderr
    entries = json.loads((out / "signatures.json").read_text())["frames"]
    assert [entry["signed"] for entry in entries] == [True, False, False, False, True]
    assert "8" in entries[1]["reason"]
    # the same depth as PNG and as NPY, but for the rounding of 1/1000
    assert (out / entries[0]["file"]).read_bytes() == (out / entries[4]["file"]).read_bytes()


def test_signatures_of_two_models_do_not_mix(rooms, model_file, small_model, tmp_path):
    out = tmp_path / "out"
    run("sign", rooms / "room-000", "--model", model_file, "--out", out)
    before = tree_hash(out)
    other = tmp_path / "other.safetensors"
    save_model(replace(small_model, quantiser_step=0.004), other)
    done = run("sign", rooms / "room-000", "--model", other, "--out", out, expect=2)
    assert "contains signatures of another model" in done.stderr
    assert tree_hash(out) == before


def test_an_old_signature_does_not_outlive_its_frame(frames, model_file, tmp_path):
    (folder, _), out = frames, tmp_path / "out"
    run("sign", folder, "--model", model_file, "--out", out)
    assert [name for name in tree_hash(out) if name.endswith(".sig")] == ["frames/a.sig"]
    (folder / "a.png").write_bytes(b"no longer a picture")
    run("sign", folder, "--model", model_file, "--out", out, expect=2)
    assert list(tree_hash(out)) == ["signatures.json"]


def test_names_that_no_line_can_hold(frames, model_file):
    folder, _ = frames
    (folder / "a.png").rename(folder / "a\nb\x1b[2Jü.png")
    done = run("sign", folder, "--model", model_file)
    assert len(done.stdout.splitlines()) == 1
    assert "\x1b" not in done.stdout


def test_two_paths_keep_their_names_apart(rooms, model_file, tmp_path):
    out = tmp_path / "out"
    run("sign", rooms / "room-000", rooms / "room-001", "--model", model_file, "--out", out)
    entries = json.loads((out / "signatures.json").read_text())["frames"]
    assert len({entry["name"] for entry in entries}) == 4
    done = run("sign", rooms / "room-000", rooms / "room-000", "--model", model_file, expect=2)
    assert "is also the name of" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sign", "/nowhere/at/all"], "does not exist"),
        (["sign", "README.md"], "The file is neither a depth image (PNG, NPY"),
        (["sign", "{rooms}", "--model", "/nowhere.safetensors"], "Specify one of the presets"),
        (["train", "--out", "{tmp}/m", "--rooms", "1", "--jobs", "1"], "fewer than two places"),
        (["synth", "/dev/null/x"], "/dev/null"),
        (["train", "--out", "{tmp}/m", "--range", "9", "3"], "Put the smaller distance first"),
        (["train", "--out", "{tmp}", "--rooms", "2"], "is a folder"),
    ],
)
def test_errors_are_one_line_and_exit_code_2(arguments, message, rooms, tmp_path):
    done = run(*(a.format(rooms=rooms, tmp=tmp_path) for a in arguments), expect=2)
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"sceneprint {arguments[0]}: ")
    assert message in last


@pytest.mark.parametrize("arguments", [["sign"], ["synth", "x", "--rooms", "0"], ["no"]])
def test_wrong_usage(arguments):
    done = run(*arguments, expect=2)
    assert done.stderr.startswith("usage: sceneprint")


#: What a command that only speaks HTTP does not need, and takes longer to import than all it does.
HEAVY = {
    "numpy", "scipy", "numba", "faiss", "sqlalchemy", "PIL", "rich", "sceneprint.engine",
    "sceneprint.settings", "sceneprint.store", "service",
}  # fmt: skip


def test_a_command_imports_only_what_it_needs():
    code = (
        "import sys; from sceneprint.cli import main\n"
        "for one in sys.argv[1:]:\n"
        "    try: main(one.split())\n"
        "    except SystemExit: pass\n"
        "print(); print(*sys.modules)"
    )

    def loaded(*commands):
        """Return the modules that a process has loaded after it has run all these commands."""
        done = subprocess.run(
            [sys.executable, "-c", code, *commands], capture_output=True, text=True, check=True
        )
        return set(done.stdout.splitlines()[-1].split())

    of_help = loaded("--version", "--help")
    assert [line for line in of_help if line.startswith("sceneprint.cli.")] == []
    assert (HEAVY | {"pydantic", "httpx", "sceneprint_lab.cli.demo"}) & of_help == set()
    over_http = [f"{name} --url http://127.0.0.1:9" for name in ("maps", "jobs", "queries")]
    # what the last two write as files needs no numpy either
    of_client = loaded(*over_http, "frames --help", "sessions --help")
    assert "sceneprint_client.client" in of_client
    assert HEAVY & of_client == set()
    of_others = loaded("serve --help", "synth --help")
    assert {"sceneprint.cli.serve", "sceneprint_lab.cli.synth"} <= of_others
    unneeded = {
        "sceneprint.cli.sign", "sceneprint_client.client", "sceneprint.engine",
        "sceneprint_lab.cli.train",
    }  # fmt: skip
    assert unneeded & of_others == set()


@pytest.mark.parametrize(
    ("words", "completions"),
    [
        (("ma",), ["maps", "make"]),
        (("make", "mesh", "hall", "--vo"), ["--voxel"]),
    ],
)
def test_a_shell_completes_commands_and_options(words, completions):
    code = (
        f"{run('completion', 'bash').stdout}\n"
        'COMP_WORDS=(sceneprint "$@"); COMP_CWORD=$#; _sceneprint; echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        ["bash", "-c", code, "bash", *words], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == completions
    assert run("completion", "zsh").stdout.endswith(run("completion", "bash").stdout)


def test_sites_are_written_as_clouds_with_poses(tmp_path):
    out = tmp_path / "sites"
    arguments = ["--rooms", "1", "--views", "2", "--seed", "5", "--jobs", "1"]
    run("synth", out, "--sensor", "lidar", *arguments)
    survey = synthesise_survey(5, 0, 2)
    (sequence,) = find_sequences(out)
    read = [reference.read() for reference in sequence.frames]
    for cloud, one in zip(read, survey.clouds, strict=True):
        assert isinstance(cloud, Cloud)
        np.testing.assert_array_equal(cloud.points, one.points)
        np.testing.assert_allclose(cloud.pose, one.pose, atol=1e-6)


@pytest.mark.parametrize(
    ("unit", "notes"),
    [
        (1.0, []),
        (1e3, ["poses of consecutive frames are 1e+03 m apart: check that they are in metres"]),
    ],
)
def test_poses_in_millimetres_are_doubted(unit, notes, tmp_path):
    (tmp_path / "intrinsics.json").write_text(json.dumps(CAMERA))
    for i in range(3):
        (tmp_path / f"{i}.png").write_bytes(b"")
        pose = np.eye(4)
        pose[0, 3] = i * unit
        np.savetxt(tmp_path / f"{i}.pose.txt", pose)
    (sequence,) = find_sequences(tmp_path)
    frames = [(sequence, frame) for frame in sequence.frames]
    assert summary_of(frames, Tally(), with_pose=True).left_out == notes
