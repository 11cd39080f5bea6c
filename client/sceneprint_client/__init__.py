"""Client of sceneprint: place recognition from depth frames and point clouds, over HTTP.

    with Client("http://robot-server:8008") as client:  # or Client.embedded("maps")
        client.create_map("warehouse")
        client.upload("warehouse", path, wait_s=10)
        answer = client.query("warehouse", path)

Each name is loaded at its first use, so importing the package is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneprint_client.client import AsyncClient, Client, Status
    from sceneprint_client.frame_files import FrameFile, meta_of
    from sceneprint_client.joiner import Joiner
    from sceneprint_client.spool import Spool
    from sceneprint_client.tracker import AsyncTracker, State, Tracker

__version__ = "1.0.0"
__all__ = [
    "AsyncClient",
    "AsyncTracker",
    "Client",
    "FrameFile",
    "Joiner",
    "Spool",
    "State",
    "Status",
    "Tracker",
    "__version__",
    "meta_of",
]

_HOME = {
    "AsyncClient": "client",
    "AsyncTracker": "tracker",
    "Client": "client",
    "FrameFile": "frame_files",
    "Joiner": "joiner",
    "Spool": "spool",
    "State": "tracker",
    "Status": "client",
    "Tracker": "tracker",
    "meta_of": "frame_files",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'sceneprint_client' has no attribute {name!r}")
    return getattr(import_module(f"sceneprint_client.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
