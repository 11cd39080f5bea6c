"""What every baseline does, so that one loop can ask them all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from sceneprint.lab.evaluation.baselines.fpfh import FpfhVlad
from sceneprint.lab.evaluation.baselines.rings import Rings
from sceneprint.lab.evaluation.baselines.thumbnails import Thumbnails
from sceneprint.types import AnyFrame, Floats, Floats32


class Baseline(Protocol):
    """A way to compare frames that knows nothing of signatures."""

    name: str

    def check(self) -> None:
        """Raise MissingDependency where what it needs is not there."""
        ...

    def takes(self, frame: AnyFrame) -> bool:
        """Whether it is made for such a frame."""
        ...

    def read(self, frame: AnyFrame) -> Floats32:
        """What it keeps of a frame; UselessFrame where that is nothing."""
        ...

    def learn(self, database: Iterable[Floats32], count: int, seed: int) -> None:
        """Learn from what was kept of the `count` frames of the database."""
        ...

    def finish(self, kept: Floats32) -> Floats32:
        """The descriptor of what was kept of a frame; of one shape for all."""
        ...

    def distances(self, query: Floats32, database: Floats32) -> Floats:
        """(N,) from one descriptor to each of a stack of N; infinite is farthest."""
        ...


#: Each baseline, made for a sensor of so many metres of range.
BASELINES: dict[str, Callable[[float], Baseline]] = {
    "thumbnail_l1": lambda _: Thumbnails("l1"),
    "thumbnail_zncc": lambda _: Thumbnails("zncc"),
    "fpfh_vlad": FpfhVlad,
    "rings": lambda _: Rings(),
}


def open_baselines(names: Sequence[str], maximum: float) -> list[Baseline]:
    """Baselines by their names, ready to be asked.

    Parameters
    ----------
    names : keys of BASELINES
    maximum : range of the sensor, metres

    Raises
    ------
    MissingDependency : a library one needs is absent.
    """
    opened = [BASELINES[name](maximum) for name in names]
    for one in opened:
        one.check()
    return opened
