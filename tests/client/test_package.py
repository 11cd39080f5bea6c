"""Tests of the client's package: its imports, its shared code with the service, and its wheel."""

import math
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import get_args

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
    versions = {project["version"] for project in (main, client, lab, viewers)}
    assert versions == {sceneprint_client.__version__}
    major, minor = client["version"].split(".")[:2]
    bounds = f">={major}.{minor},<{major}.{int(minor) + 1}"
    assert f"sceneprint-client{bounds}" in main["dependencies"]
    for project in (lab, viewers):
        assert f"sceneprint{bounds}" in project["dependencies"]
    assert {dependency.partition(">")[0] for dependency in client["dependencies"]} == {
        "httpx", "numpy", "pydantic",
    }  # fmt: skip
