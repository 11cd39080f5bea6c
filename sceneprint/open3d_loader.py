"""Open3D, where it earns its place: loaded when asked for, refused by name where it is missing."""

from __future__ import annotations

from typing import Any

from sceneprint.errors import MissingDependency

#: Debian packages with the system libraries that Open3D loads.
PACKAGES = "libgl1 libegl1 libx11-6 libusb-1.0-0 libgomp1"


def open3d(what: str) -> Any:
    """The open3d module, to work in one thread.

    Parameters
    ----------
    what : needs it, as a message begins

    Raises
    ------
    MissingDependency : it, or a system library it needs, is absent.
    """
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        raise MissingDependency(
            f"{what} needs Open3D, which cannot be imported here ({error}). Install it "
            f"(pip install open3d), and on Debian or Ubuntu: apt-get install {PACKAGES}"
        ) from error
    module.utility.set_max_threads(1)  # one process, one processor; and one order of sums
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module
