"""Which way is up, of an accelerometer at rest.

Accelerations.add ...  --Accelerations.up_at-->  unit vectors in the IMU's axes
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np

from sceneprint_client.errors import DatasetError
from sceneprint_client.rotations import Floats
from sceneprint_client.transform_tree import first_since

#: Seconds before and after a stamp over which accelerations are averaged.
WINDOW_S = 0.5
#: Fewest samples of such a window.
_FEWEST = 10
#: At rest are mean accelerations of this length within this, m/s^2, ...
_GRAVITY, _OFF = 9.81, 0.3
#: ... that vary by less than this (standard deviation of all axes), m/s^2, ...
_SPREAD = 0.25
#: ... while the robot turns by less than this on average, radians per second.
_TURN = 0.05
_MOST_SAMPLES = 10_000_000


class Accelerations:
    """Measurements of an IMU over time."""

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._rows = array("d")  # 6 each: acceleration, angular velocity

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, stamp_ns: int, acceleration: Sequence[float], turn: Sequence[float]) -> None:
        """Take a measurement: m/s^2 and radians per second, along the IMU's axes.

        Raises
        ------
        DatasetError : there are more than 10 million.
        """
        row = [*acceleration, *turn]
        if not np.isfinite(row).all():
            return
        if len(self._stamps_ns) >= _MOST_SAMPLES:
            raise DatasetError(
                f"The recording has more than {_MOST_SAMPLES} measurements of one IMU. Cut it "
                "into parts."
            )
        self._stamps_ns.append(stamp_ns)
        self._rows.extend(row)

    def forget(self, span_ns: int) -> None:
        """Drop measurements that came before those of so long until the latest."""
        old = first_since(self._stamps_ns, span_ns)
        del self._stamps_ns[:old], self._rows[: 6 * old]

    def up_at(self, stamps_ns: Sequence[int]) -> list[Floats | None]:
        """Up (3,) in the IMU's axes at each stamp; None where the robot was not at rest.

        At rest an accelerometer measures 9.81 m/s^2 upwards. The mean is taken over a second.
        """
        recorded = np.frombuffer(self._stamps_ns, np.int64)
        order = np.argsort(recorded, kind="stable")
        times = recorded[order]
        rows = np.frombuffer(self._rows, np.float64).reshape(-1, 6)[order]
        window = int(WINDOW_S * 1e9)
        found: list[Floats | None] = []
        for stamp in stamps_ns:
            a, b = np.searchsorted(times, [stamp - window, stamp + window + 1])
            found.append(_up(rows[a:b]) if b - a >= _FEWEST else None)
        return found


def _up(rows: Floats) -> Floats | None:
    """Up of measurements (N, 6) in a row, or None where they are not of rest."""
    acceleration, turn = rows[:, :3], rows[:, 3:]
    mean = acceleration.mean(axis=0)
    length = float(np.linalg.norm(mean))
    spread = float(np.sqrt(acceleration.var(axis=0).sum()))
    turning = float(np.linalg.norm(turn, axis=1).mean())
    if abs(length - _GRAVITY) > _OFF or spread > _SPREAD or turning > _TURN:
        return None
    up: Floats = mean / length
    return up
