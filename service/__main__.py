"""`python -m service`: run the service without workers, with settings from the environment."""

from __future__ import annotations

import os
import signal
import sys

from pydantic import ValidationError

from sceneprint.errors import SceneprintError
from sceneprint.process import log_as_json, read_secret_files
from sceneprint.settings import Settings
from service.server import run


def main() -> int:
    """Serve until a signal ends the process; print errors in one line, and return 2 for them."""
    log_as_json()
    # uvicorn handles both signals while it runs, and raises them again after it stops.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        read_secret_files(os.environ)
        run(Settings(), lambda url, _: print(f"sceneprint: serving {url}", flush=True))  # noqa: T201
    except (SceneprintError, ValidationError) as error:
        print(f"service: {' '.join(str(error).split())}", file=sys.stderr)  # noqa: T201
        return 2
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
