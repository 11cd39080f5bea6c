"""sceneprint: place recognition from pure geometry.

    signer = sceneprint.open_signer("depth")
    signature, geometry = sceneprint.prepare(frame, signer)
    ranking = sceneprint.retrieve(signature, signatures, signer.model)  # R
    selection = sceneprint.diversify(ranking, signatures)  # C
    matches = sceneprint.associate(geometry, ranking, selection.indices, open_geometry)  # C_vld
    views_of = sceneprint.views_of_rows(matches, poses, open_geometry)
    place = sceneprint.localize([sceneprint.QueryFrame(geometry, matches)], poses, None, views_of)

    answer = sceneprint.Client("http://robot-server:8008").query("warehouse", path)  # all steps

A module is imported when one of its names is first used.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneprint.formats.artifact import read_geometry, write_geometry
    from sceneprint.formats.dataset import find_sequences, make_frame, read_frame
    from sceneprint.formats.points.cloud import decode_cloud
    from sceneprint.geometry.validation.validation import PairValidation
    from sceneprint.localization import PoseEstimate, localize, views_of_rows
    from sceneprint.models import Model, read_model
    from sceneprint.pipeline import (
        PairMatch,
        Signature,
        Signer,
        associate,
        distance,
        diversify,
        open_signer,
        prepare,
        retrieve,
        sign,
        validate,
    )
    from sceneprint.places import QueryFrame
    from sceneprint.types import Cloud, DepthFrame, Geometry, Intrinsics
    from sceneprint_client import Client

__all__ = [
    "Client",
    "Cloud",
    "DepthFrame",
    "Geometry",
    "Intrinsics",
    "Model",
    "PairMatch",
    "PairValidation",
    "PoseEstimate",
    "QueryFrame",
    "Signature",
    "Signer",
    "associate",
    "decode_cloud",
    "distance",
    "diversify",
    "find_sequences",
    "localize",
    "make_frame",
    "open_signer",
    "prepare",
    "read_frame",
    "read_geometry",
    "read_model",
    "retrieve",
    "sign",
    "validate",
    "views_of_rows",
    "write_geometry",
]

__version__ = _version("sceneprint")

_MODULES = {
    "Cloud": "types",
    "DepthFrame": "types",
    "Geometry": "types",
    "Intrinsics": "types",
    "PoseEstimate": "localization",
    "QueryFrame": "places",
    "PairMatch": "pipeline",
    "Model": "models",
    "Signature": "pipeline",
    "Signer": "pipeline",
    "PairValidation": "geometry.validation.validation",
    "associate": "pipeline",
    "decode_cloud": "formats.points.cloud",
    "distance": "pipeline",
    "diversify": "pipeline",
    "find_sequences": "formats.dataset",
    "localize": "localization",
    "make_frame": "formats.dataset",
    "open_signer": "pipeline",
    "prepare": "pipeline",
    "read_frame": "formats.dataset",
    "read_geometry": "formats.artifact",
    "read_model": "models",
    "retrieve": "pipeline",
    "sign": "pipeline",
    "validate": "pipeline",
    "views_of_rows": "localization",
    "write_geometry": "formats.artifact",
}


def __getattr__(name: str) -> Any:
    if name == "Client":
        return import_module("sceneprint_client").Client
    if name not in _MODULES:
        raise AttributeError(f"module 'sceneprint' has no attribute {name!r}")
    return getattr(import_module(f"sceneprint.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
