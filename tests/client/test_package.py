"""Tests of the client's package: its imports, its shared code with the service, and its wheel."""

import json
import math
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import get_args

import pytest

import sceneprint_client
from sceneprint.geometry.retrieval.ranking import DiversityParameters, Metric
from sceneprint.geometry.validation.acceptance import AcceptanceParameters, Mode
from sceneprint.models import PRESETS
from sceneprint_client.api import Diversity, ValidationOptions
from sceneprint_client.api import maps as map_records
from sceneprint_client.api.admin import ModelInfo

ROOT = Path(__file__).parents[2]


#: Prints the modules that are loaded after each step.
STEPS = """
import sys
import sceneprint_client; print(*sys.modules)
from sceneprint_client import Client; Client().close(); print(*sys.modules)
from sceneprint_client import meta_of; print(*sys.modules)
"""


def test_a_robot_loads_the_client_alone():
    heavy = {"numba", "fastapi", "starlette", "sqlalchemy", "faiss", "sceneprint", "service"}
    done = subprocess.run([sys.executable, "-c", STEPS], capture_output=True, text=True, check=True)
    package, client, frames = (set(line.split()) for line in done.stdout.splitlines())
    assert (heavy | {"numpy", "httpx", "pydantic"}) & package == set()
    assert (heavy | {"numpy"}) & client == set()
    assert {"httpx", "pydantic"} <= client
    assert heavy & frames == set()


def test_the_records_say_what_the_service_does():
    assert map_records.PRESETS == PRESETS
    assert ModelInfo.model_fields["metric"].annotation == Metric
    assert ValidationOptions.model_fields["mode"].annotation == Mode
    diversity, acceptance = DiversityParameters(), AcceptanceParameters()
    assert Diversity().model_dump() == vars(diversity)
    options = ValidationOptions().model_dump(exclude={"mode", "residual_deg"})
    assert options == {name: getattr(acceptance, name) for name in options}
    assert ValidationOptions().mode == get_args(Mode)[0]
    assert math.radians(ValidationOptions().residual_deg) == acceptance.residual_rad


def test_the_distributions_have_one_version():
    main, client, lab, viewers = (
        tomllib.loads((folder / "pyproject.toml").read_text())["project"]
        for folder in (ROOT, ROOT / "client", ROOT / "lab", ROOT / "viewers")
    )
    versions = {one["version"] for one in (main, client, lab, viewers)}
    assert versions == {sceneprint_client.__version__}
    major, minor = client["version"].split(".")[:2]
    bounds = f">={major}.{minor},<{major}.{int(minor) + 1}"
    assert f"sceneprint-client{bounds}" in main["dependencies"]
    for one in (lab, viewers):
        assert f"sceneprint{bounds}" in one["dependencies"]
    assert {one.partition(">")[0] for one in client["dependencies"]} == {
        "httpx", "numpy", "pydantic",
    }  # fmt: skip


def oldest_python():
    """A Python 3.10 that starts (a shim of pyenv may not), or the Python of the tests."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    for found in (shutil.which("python3.10"), *pyenv.glob("versions/3.10.*/bin/python3.10")):
        if (
            found
            and not subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode
        ):
            return str(found)
    return sys.executable


#: Maps a place from files, loses its way in it, and is told what it does wrong.
ROBOT = """
import json, sys
from sceneprint_client import Client, errors
from sceneprint_client.api import JobState
url, asked, *mapped = sys.argv[1:]
told = {"python": sys.version_info[:2], "state": [str(JobState.QUEUED), f"{JobState.QUEUED}"]}
with Client(url) as client:
    client.create_map("wheel", model="depth")
    told["healthy"] = client.healthy()
    told["uploads"] = [client.upload("wheel", path, wait_s=60).state for path in mapped]
    answer = client.localize("wheel", asked)
    told["status"] = answer.status
    translation = answer.pose.translation
    told["at"] = [translation.x, translation.y, translation.z]
    try:
        client.frame("wheel", "nobody")
    except errors.UnknownFrame as error:
        told["frame"] = str(error)
    client.delete_map("wheel")
try:
    Client.embedded("nowhere")
except errors.MissingDependency as error:
    told["embedded"] = str(error)
from sceneprint_client import meta_of
told["loaded"] = sorted({"sceneprint", "numba", "scipy"} & set(sys.modules))
print(json.dumps(told))
"""


@pytest.mark.thorough
def test_the_wheel_localises_alone(tmp_path, service_url, references):
    """In an empty environment, of the oldest Python that there is, against a service over HTTP."""
    source = tmp_path / "source"
    shutil.copytree(ROOT / "client", source, ignore=shutil.ignore_patterns("*.egg-info", "build"))
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    built = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path)]
    subprocess.run([*built, str(source)], check=True)
    [wheel] = tmp_path.glob("sceneprint_client-*-py3-none-any.whl")
    python, oldest = tmp_path / "env" / "bin" / "python", oldest_python()
    subprocess.run([oldest, "-m", "venv", str(tmp_path / "env")], check=True)
    installed = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
    subprocess.run([*installed, str(wheel)], check=True)
    mapped = references[:3]
    asked = mapped[1]
    done = subprocess.run(
        [str(python), "-I", "-c", ROBOT, service_url, asked.path, *(one.path for one in mapped)],
        capture_output=True, text=True, cwd=tmp_path, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["python"] == [3, 10] or oldest == sys.executable
    assert told["state"] == ["queued", "queued"]
    assert told["healthy"]
    assert told["uploads"] == ["indexed"] * len(mapped)
    assert told["status"] == "found"
    assert math.dist(told["at"], asked.pose[:3, 3]) < 0.10
    assert told["frame"].startswith("There is no frame 'nobody'")
    assert told["embedded"].endswith("In a clone, run: pip install .")
    assert told["loaded"] == []
