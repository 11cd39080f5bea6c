"""sceneprint: place recognition from pure geometry.

    signer = sceneprint.open_signer("paper")
    signature = sceneprint.sign(frame, signer)

Names are loaded when first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneprint.datasets import find_sequences, make_frame, read_frame
    from sceneprint.models import Model, read_model
    from sceneprint.pipeline import Signature, Signer, distance, open_signer, sign
    from sceneprint.types import Frame, Intrinsics

__all__ = [
    "Frame",
    "Intrinsics",
    "Model",
    "Signature",
    "Signer",
    "distance",
    "find_sequences",
    "make_frame",
    "open_signer",
    "read_frame",
    "read_model",
    "sign",
]

__version__ = _version("sceneprint")

_HOME = {
    "Frame": "types",
    "Intrinsics": "types",
    "Model": "models",
    "Signature": "pipeline",
    "Signer": "pipeline",
    "distance": "pipeline",
    "find_sequences": "datasets",
    "make_frame": "datasets",
    "open_signer": "pipeline",
    "read_frame": "datasets",
    "read_model": "models",
    "sign": "pipeline",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'sceneprint' has no attribute {name!r}")
    return getattr(import_module(f"sceneprint.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
