"""`python -m worker`: run worker processes with settings from the environment."""

from __future__ import annotations

import sys

from pydantic import ValidationError

from sceneprint.engine.context import require_writable
from sceneprint.errors import SceneprintError
from sceneprint.process import log_as_json
from sceneprint.settings import Settings
from worker.supervisor import run


def main() -> int:
    """Run workers until a signal ends them; print errors in one line, and return 2 for them."""
    log_as_json()
    try:
        settings = Settings()
        require_writable(settings)  # report errors once, instead of in each worker
        run(settings)
    except (SceneprintError, ValidationError) as error:
        print(f"worker: {' '.join(str(error).split())}", file=sys.stderr)  # noqa: T201
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
