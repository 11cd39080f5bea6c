"""sceneprint: place recognition from pure geometry.

    signer = sceneprint.open_signer("depth")
    signature, geometry = sceneprint.prepare(frame, signer)
    ranking = sceneprint.retrieve(signature, signatures, signer.model)  # R
    selection = sceneprint.diversify(ranking, signatures)  # C
    matches = sceneprint.associate(geometry, ranking, selection.indices, open_geometry)  # C_vld
    location = sceneprint.locate(matches, poses)

    answer = sceneprint.Client("http://robot-server:8008").query("warehouse", path)  # all at once

Names are loaded when first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneprint.artifacts import read_geometry, write_geometry
    from sceneprint.client import Client
    from sceneprint.datasets import find_sequences, make_frame, read_frame
    from sceneprint.geometry.validation import Validation
    from sceneprint.matches import Location, Match, associate, locate
    from sceneprint.models import Model, read_model
    from sceneprint.pipeline import (
        Signature,
        Signer,
        distance,
        diversify,
        open_signer,
        prepare,
        retrieve,
        sign,
        validate,
    )
    from sceneprint.scans import decode_cloud
    from sceneprint.types import Cloud, Frame, Geometry, Intrinsics

__all__ = [
    "Client",
    "Cloud",
    "Frame",
    "Geometry",
    "Intrinsics",
    "Location",
    "Match",
    "Model",
    "Signature",
    "Signer",
    "Validation",
    "associate",
    "decode_cloud",
    "distance",
    "diversify",
    "find_sequences",
    "locate",
    "make_frame",
    "open_signer",
    "prepare",
    "read_frame",
    "read_geometry",
    "read_model",
    "retrieve",
    "sign",
    "validate",
    "write_geometry",
]

__version__ = _version("sceneprint")

_HOME = {
    "Client": "client",
    "Cloud": "types",
    "Frame": "types",
    "Geometry": "types",
    "Intrinsics": "types",
    "Location": "matches",
    "Match": "matches",
    "Model": "models",
    "Signature": "pipeline",
    "Signer": "pipeline",
    "Validation": "geometry.validation",
    "associate": "matches",
    "decode_cloud": "scans",
    "distance": "pipeline",
    "diversify": "pipeline",
    "find_sequences": "datasets",
    "locate": "matches",
    "make_frame": "datasets",
    "open_signer": "pipeline",
    "prepare": "pipeline",
    "read_frame": "datasets",
    "read_geometry": "artifacts",
    "read_model": "models",
    "retrieve": "pipeline",
    "sign": "pipeline",
    "validate": "pipeline",
    "write_geometry": "artifacts",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'sceneprint' has no attribute {name!r}")
    return getattr(import_module(f"sceneprint.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
