"""`python -m worker`: worker processes, by the settings of the environment."""

from __future__ import annotations

import sys

from pydantic import ValidationError

from sceneprint.engine.context import require_writable
from sceneprint.errors import SceneprintError
from sceneprint.process import log_as_json
from sceneprint.settings import Settings
from worker.supervisor import run


def main() -> int:
    """Work until told to stop; errors are one line and exit code 2."""
    log_as_json()
    try:
        settings = Settings()
        require_writable(settings)  # what is wrong is said once, and not by every worker
        run(settings)
    except (SceneprintError, ValidationError) as error:
        print(f"worker: {' '.join(str(error).split())}", file=sys.stderr)  # noqa: T201
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
