"""Run the tests that depend on floating point as on other processors.

    python tools/portable_tests.py [--list] [TARGET ...]

Vector lengths, fused products and branches of the C library change the last bits of results. Each
target selects other code paths where libraries depend on the processor: numba's machine code,
numpy's loops, the BLAS of numpy, SciPy and FAISS, and glibc's exp, sin and so on. Embree has no
such option, so the target `rays`, a plugin of pytest, changes its results by a last bit.
A bound that holds on only one target is too tight.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sceneprint.types import Floats32
    from sceneprint_lab.synth.sensors import Caster, RayHits

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = (
    "geometry", "models", "index", "evaluation", "synth", "scans", "datasets", "recordings",
    "engine",
)  # fmt: skip
FILES = (
    "artifacts", "artifacts_clouds", "cloud_signing", "clouds", "fusion", "golden", "graphs",
    "guided", "localization", "lookalikes", "pipeline", "points", "quality", "retrieve",
    "training", "training_lidar", "vistas",
)  # fmt: skip
#: Code that prints numpy's loops for this processor beyond those of the oldest x86-64.
NUMPY_LOOPS = (
    "from numpy._core._multiarray_umath import __cpu_dispatch__ as d, __cpu_features__ as has; "
    "print(*(name for name in d if has[name]))"
)
KERNELS = (
    "from sceneprint.cli.preparation import prepare_presets; "
    "from sceneprint.settings import Settings; prepare_presets(Settings(), clouds=True)"
)


def generic() -> dict[str, str]:
    """Return the environment of an x86-64 processor without AVX and FMA."""
    loops = subprocess.run(
        [sys.executable, "-c", NUMPY_LOOPS], capture_output=True, text=True, check=True
    )
    return {
        "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "FAISS_SIMD_LEVEL": "NONE",
        "NPY_DISABLE_CPU_FEATURES": loops.stdout.strip(),
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F",
    }  # fmt: skip


def targets() -> dict[str, dict[str, str]]:
    """Return the environments of the targets by name."""
    cores = ["Haswell", "Zen", "Prescott"]
    if "avx512dq" in Path("/proc/cpuinfo").read_text():  # OpenBLAS does not check the processor
        cores.append("SkylakeX")
    blas = {f"OpenBLAS-{core}": {"OPENBLAS_CORETYPE": core} for core in cores}
    return {"as-is": {}, "generic": generic(), "rays": {}, **blas, "one-core": {}}


def run(name: str, environment: dict[str, str]) -> bool:
    """Run the tests of a target; return whether all passed."""
    paths = [f"tests/{name}" for name in FOLDERS] + [f"tests/test_{name}.py" for name in FILES]
    every = os.sched_getaffinity(0)
    processes = 2 if name == "one-core" else 2 * len(every)
    print(f"== {name} {environment}", flush=True)
    try:
        if name == "one-core":
            os.sched_setaffinity(0, {min(every)})
        whole = os.environ | environment
        subprocess.run([sys.executable, "-c", KERNELS], check=True, cwd=ROOT, env=whole)
        command = [sys.executable, "-m", "pytest", "-q", "-n", str(processes),
                   "--dist", "loadfile", "--no-loadscope-reorder", *paths]  # fmt: skip
        command += ["-p", "tools.portable_tests"] if name == "rays" else []
        return subprocess.run(command, check=False, cwd=ROOT, env=whole).returncode == 0
    finally:
        os.sched_setaffinity(0, every)


def pytest_configure() -> None:
    """Change the distance of each ray hit by at most a unit in the last place."""
    import numpy as np

    from sceneprint_lab.synth import sensors

    cast = sensors.Caster.cast

    def moved(caster: Caster, origins: Floats32, directions: Floats32) -> RayHits:
        hits = cast(caster, origins, directions)
        steps = np.random.default_rng(0).integers(-1, 2, len(hits.distance)) * 2.0**-23
        return replace(hits, distance=(hits.distance * (1.0 + steps)).astype(np.float32))

    sensors.Caster.cast = moved  # type: ignore[method-assign, assignment]


def main(arguments: list[str]) -> int:
    """Run the given targets or all; return 1 if a test failed."""
    known = targets()
    if "--list" in arguments or set(arguments) - set(known):
        print(*known, sep="\n")
        return 0 if arguments == ["--list"] else 2
    results = {name: run(name, known[name]) for name in arguments or known}
    for name, passed in results.items():
        print(f"{'passed' if passed else 'FAILED'}  {name}")
    return 0 if all(results.values()) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
