"""A fleet of the version before, brought to this one while robots go on.

upgrade(fleet, seconds)  -->  each part replaced, one after the other, behind a migrated database
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable

from benchmarks.fleet.fleet import Fleet, await_service
from benchmarks.fleet.postgres_pair import DATABASE

#: Part of the time before the first and after the last step.
CALM = 0.15


def upgrade(fleet: Fleet, seconds: float, tell: Callable[[str], None]) -> list[str]:
    """Migrate the database under load, then replace workers and services, as docs/upgrading.md
    says: each is asked to end, and started again as this version.

    Parameters
    ----------
    fleet : of the version before
    seconds : for which the robots walk
    tell : told of each step

    Returns
    -------
    steps : what was done, in order
    """
    begun = time.monotonic()
    parts = [*fleet.workers, *fleet.services]
    each = seconds * (1 - 2 * CALM) / (len(parts) + 1)
    steps = []
    for i in range(len(parts) + 1):
        time.sleep(max(begun + seconds * CALM + i * each - time.monotonic(), 0.0))
        part = parts[i - 1] if i else None
        if part is None:
            tell("the database")
            before = _schema(fleet)
            subprocess.run(
                [sys.executable, "-m", "sceneprint", "migrate", "--data", str(fleet.host)],
                env=fleet.environment(), check=True, stdout=subprocess.DEVNULL,
            )  # fmt: skip
            steps.append(f"the database (schema {before} to {_schema(fleet)})")
            continue
        steps.append(part.name)
        tell(part.name)
        part.end()
        part.take_present()
        part.begin()
        if part in fleet.services:
            await_service(fleet.urls[fleet.services.index(part)])
    return steps


def _schema(fleet: Fleet) -> str:
    [(revision,)] = fleet.pair.primary.execute("SELECT version_num FROM alembic_version", DATABASE)
    return str(revision)
