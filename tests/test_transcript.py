"""Tests of the commands of docs/from_bag_to_pose.md and docs/whole_maps.md in a new folder.

The output of the former must match the page; SCENEPRINT_UPDATE_GOLDEN=1 updates it.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.waiting import free_port

ROOT = Path(__file__).resolve().parent.parent
PAGE, WHOLE_MAPS = ROOT / "docs/from_bag_to_pose.md", ROOT / "docs/whole_maps.md"
BLOCK = re.compile(r"(?<=^```console\n)(.*?)(?=^```$)", re.DOTALL | re.MULTILINE)
#: Where the reader of the page is, and the service.
HERE, URL = "/home/robot/sceneprint", "http://127.0.0.1:8008"
#: Seconds for one command: what compiles on a slow machine takes minutes.
PATIENCE_S = 900
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def transcripts(text):
    """Of each block its commands, each with the lines that it prints."""
    parsed = []
    for block in BLOCK.findall(text):
        commands = []
        for line in block.splitlines():
            if line.startswith("$ "):
                commands.append((line[2:], []))
            else:
                commands[-1][1].append(line)
        parsed.append(commands)
    return parsed


def shape(lines):
    """Lines with a mark for each number: another processor rounds poses otherwise."""
    return [NUMBER.sub("#", line).split() for line in lines]


@pytest.fixture
def said(tmp_path):
    """Runs a command as the page's reader does; with a number of lines it is left running."""
    port = free_port()
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "examples").symlink_to(ROOT / "examples")
    environment = {
        **os.environ, "PYTHONUNBUFFERED": "1", "SCENEPRINT_WORKERS": "1",
        "SCENEPRINT_PORT": str(port), "SCENEPRINT_URL": f"http://127.0.0.1:{port}",
        "SCENEPRINT_DATA_DIR": str(tmp_path / "data"),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }  # fmt: skip
    running = []

    def shown(text):
        return text.replace(str(tmp_path / "here"), HERE).replace(f"127.0.0.1:{port}", URL[7:])

    def run(command, lines):
        # `exec`: what is left running is the command itself, and no shell around it
        process = subprocess.Popen(
            ["bash", "-c", f"exec {command}"], cwd=tmp_path / "here", env=environment,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        if lines:
            running.append(process)
            return [shown(process.stdout.readline()).rstrip() for _ in range(lines)]
        text, _ = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, text
        return shown(text).splitlines()

    yield run
    for process in running:
        process.terminate()
        process.communicate(timeout=PATIENCE_S)


@pytest.mark.thorough
def test_the_page_says_what_happens(said):
    text = PAGE.read_text(encoding="utf-8")
    blocks = transcripts(text)
    for block in blocks:
        for place, (command, _) in enumerate(block):
            if not command.startswith("pip "):  # it is installed, and nothing is downloaded here
                block[place] = (command, said(command, 2 if " serve" in command else 0))
    if os.environ.get("SCENEPRINT_UPDATE_GOLDEN") == "1":
        updated = iter(
            "".join(f"{line}\n" for command, lines in block for line in (f"$ {command}", *lines))
            for block in blocks
        )
        text = BLOCK.sub(lambda _: next(updated), text)
        PAGE.write_text(text, encoding="utf-8")
    for page, ran in zip(transcripts(text), blocks, strict=True):
        for (command, expected), (_, lines) in zip(page, ran, strict=True):
            assert shape(lines) == shape(expected), command
    tracked = [line for block in blocks for _, lines in block for line in lines]
    assert "tracking on 12 of 12 frames, first fix after 0 s" in tracked


@pytest.mark.thorough
def test_a_map_in_one_file_leads_to_a_pose(said):
    (commands,) = transcripts(WHOLE_MAPS.read_text(encoding="utf-8"))
    assert len(commands) == 5
    for command, expected in commands:
        lines = said(command, 2 if " serve" in command else 0)
        if " localize " in command:  # which of the matches agree may be another
            assert lines[0].startswith("site-000/scan-000003: found ")
            place = [float(part) for part in lines[1].split()[1:4]]
            assert place == pytest.approx([4.436, 13.913, 0.854], abs=0.1)
            continue
        lines = [line for line in lines if not line.startswith("weak area: ")]
        assert shape(lines) == shape(expected)
