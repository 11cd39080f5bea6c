"""Compiling kernels before anyone waits for them, in processes of their own beside each other.

A process that compiles answers nobody meanwhile. So kernels are compiled by others, which leave
the machine code on disk: those of signing by one, those of validation by another, as neither
needs the other's. Kernels of clouds are compiled when the first cloud comes.

    python -m sceneprint.engine.compilation signing|validation|clouds FOLDER_OF_TABLES
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from sceneprint.errors import SceneprintError
from sceneprint.formats.artifact import read_geometry
from sceneprint.geometry.kernel import cached_at
from sceneprint.geometry.signature import pair_table
from sceneprint.geometry.surface import cloud
from sceneprint.geometry.validation import icp
from sceneprint.models import PRESETS, read_model

#: A kernel of each part that is among the last to be compiled: where it is, so are the others.
_LAST = {
    "signing": pair_table._count,
    "validation": icp.refine_in_place,
    "clouds": cloud._gather,
}
#: What a service for depth images needs, and what it needs for clouds as well.
DEPTH, ALL = ("signing", "validation"), ("signing", "validation", "clouds")
#: Those who need kernels wait for whoever compiles them.
_compiling = threading.Lock()


class Uncompiled(SceneprintError):
    """Kernels could not be compiled ahead: they are when they are first used."""


def missing(parts: Sequence[str] = DEPTH) -> tuple[str, ...]:
    """Which of the parts are yet to be compiled for this processor, or for this version."""
    return tuple(part for part in parts if not cached_at(_LAST[part])[1])


def compile_kernels(cache_dir: Path, parts: Sequence[str] = DEPTH) -> None:
    """Compile parts that are missing, in a process each, and wait for them.

    Parameters
    ----------
    cache_dir : of pair tables: the one that signing needs is built on the way
    parts : of `ALL`

    Raises
    ------
    Uncompiled : one of the processes failed.
    """
    with _compiling:
        wanted = missing(parts)
        # clouds are validated with the kernels of the other parts: compiled twice, if beside them
        first = [part for part in wanted if part != "clouds"]
        for group in (first, [part for part in wanted if part == "clouds"]):
            begun = [(part, _begin(part, cache_dir)) for part in group]
            ended = [(part, process.communicate()[1], process) for part, process in begun]
            for part, said, process in ended:
                if process.returncode:
                    last = said.strip().splitlines()[-1:] or ["it said nothing"]
                    raise Uncompiled(
                        f"Compiling kernels for {part} failed ({last[0]:.200}). They are compiled "
                        "on first use instead."
                    )


def _begin(part: str, cache_dir: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sceneprint.engine.compilation", part, str(cache_dir)]
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        text=True, errors="replace",
    )  # fmt: skip


def _compile(part: str, cache_dir: Path) -> None:
    """Use every kernel of a part once."""
    from sceneprint.engine.models import warm_clouds, warm_signing, warm_validation
    from sceneprint.pipeline import open_signer

    model = read_model(PRESETS[0])
    p = model.parameters.validation
    # the corner as signing left it, so that validation need not wait for that
    corner = read_geometry(files("sceneprint.engine").joinpath("corner.artifact").read_bytes())
    if part == "validation":
        warm_validation(corner, p)
        return
    signer = open_signer(model, cache_dir)
    if part == "signing":
        warm_signing(signer)
    else:
        warm_clouds(signer, corner)


if __name__ == "__main__":
    _compile(sys.argv[1], Path(sys.argv[2]))
