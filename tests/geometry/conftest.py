"""Fixtures of the geometry tests: golden cases and exact scenes, loaded without a package."""

from importlib import util
from pathlib import Path

import pytest


def beside(name):
    """Return the module `name` of this folder, which importlib mode does not put on the path."""
    path = Path(__file__).resolve().with_name(f"{name}.py")
    spec = util.spec_from_file_location(f"geometry_{name}", path)
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def goldens():
    return beside("goldens")


@pytest.fixture(scope="session")
def validation_goldens():
    return beside("validation_goldens")


@pytest.fixture(scope="session")
def scenes():
    return beside("scenes")


@pytest.fixture(scope="session")
def cloud_scenes():
    return beside("cloud_scenes")
