"""What pyproject.toml cannot say: wheels that carry compiled kernels.

    SCENEPRINT_COMPILE=1 pip wheel --no-deps --no-build-isolation .

builds one for this version of Python and for processors from x86-64-v3 on (2013 and later); it
needs the dependencies installed, as it runs each kernel once. Without the variable the wheel has
no machine code and fits every machine, which then compiles on first use.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.build_py import build_py

COMPILE = os.environ.get("SCENEPRINT_COMPILE", "") not in ("", "0")
HERE = Path(__file__).resolve().parent

PROGRAM = """
import sys
from pathlib import Path
from sceneprint.engine.compilation import ALL, compile_kernels
compile_kernels(Path(sys.argv[1]), ALL, print)
"""


class BuildWithKernels(build_py):
    """Copies the packages, and compiles their kernels where they lie then."""

    def run(self) -> None:
        """Build."""
        super().run()
        if COMPILE and not self.editable_mode:
            metadata = Path(self.get_finalized_command("egg_info").egg_info)
            compile_in(Path(self.build_lib).resolve(), metadata)


class Package(Distribution):
    """The distribution; with kernels, its wheel fits one version of Python and one platform."""

    def has_ext_modules(self) -> bool:
        """Return whether the wheel contains machine code."""
        return COMPILE


def compile_in(folder: Path, metadata: Path) -> None:
    """Compile the kernels of packages in a folder, for every processor of our kind.

    The packages ask for their version, and need not be installed yet: they find it in `metadata`.
    """
    for old in [*folder.rglob("__pycache__")]:
        shutil.rmtree(old)
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    with tempfile.TemporaryDirectory() as elsewhere:  # the tables, and no checkout beside it
        shutil.copytree(metadata, Path(elsewhere) / metadata.name)
        path = (str(folder), str(HERE / "client"), elsewhere)
        environment["PYTHONPATH"] = os.pathsep.join(path)
        subprocess.run(
            [sys.executable, "-c", PROGRAM, elsewhere], cwd=elsewhere, env=environment, check=True
        )


setup(distclass=Package, cmdclass={"build_py": BuildWithKernels})
