"""Tests that the service works without the lab and the viewers."""

import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

from sceneprint.cli import COMMANDS

ROOT = Path(__file__).resolve().parent.parent
#: What only the lab or the viewers need, and what installs distributions in place.
ABSENT = ("sceneprint_lab", "sceneprint_viewers", "__editable__", "embreex", "foxglove")
#: Loads what serves, and uses the command line without a service.
PROGRAM = """
import contextlib, io, json, sys
import service.app, worker.supervisor
from sceneprint.cli import all_commands, main, parser

def run(*arguments):
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        try:
            code = main(arguments)
        except SystemExit as end:
            code = end.code
    return code, errors.getvalue()

parser().format_help()
nowhere = ("--url", "http://127.0.0.1:9", "--mcap", sys.argv[1])
print(json.dumps({
    "commands": list(all_commands()),
    "train": run("train", "--out", sys.argv[1]),
    "scenes": [run(*one, *nowhere) for one in (
        ("query", "map", "nowhere.png"), ("localize", "map", "nowhere.png"), ("frames", "map"),
        ("make", "association", "map", "--session", "a"),
    )],
    "upload": run("upload", "map", "nowhere.png", "--url", "http://127.0.0.1:9"),
}))
"""


def test_a_service_needs_neither_lab_nor_viewers(tmp_path):
    packages, file = tmp_path / "packages", tmp_path / "a.mcap"
    packages.mkdir()
    for path in Path(sysconfig.get_path("purelib")).iterdir():
        if path.suffix != ".pth" and not path.name.startswith(ABSENT):
            (packages / path.name).symlink_to(path)
    for path in ("sceneprint", "service", "worker", "migrations", "client/sceneprint_client"):
        (packages / Path(path).name).symlink_to(ROOT / path)
    done = subprocess.run(
        [sys.executable, "-S", "-c", PROGRAM, str(file)], cwd=tmp_path, text=True,
        env={**os.environ, "PYTHONPATH": str(packages)}, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    body = json.loads(done.stdout)
    assert body["commands"] == list(COMMANDS)
    code, error = body["train"]
    assert code == 2
    assert "invalid choice: 'train'" in error
    for code, error in body["scenes"]:
        assert code == 2
        assert error.count("\n") == 1
        assert error.endswith("In a clone, run: pip install ./viewers\n")
    code, error = body["upload"]
    assert code == 2
    assert "nowhere.png: The file or folder does not exist" in error
    assert not file.exists()
