"""Large scenes while they are built, and when they are ready: halls, storeys, streets.

outline, rng  --Premises-->  what is built, where one can walk, and rays to cast
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sceneprint.synth.layout import Floor
from sceneprint.synth.mesh import Mesh
from sceneprint.synth.rays import Caster

CELL = 0.2  #: metres a cell of the ground's grid
CLEARANCE = 0.45  #: of a scanner from whatever stands about, metres


@dataclass(frozen=True, eq=False)
class Premises:
    """A large scene in which a scanner can be carried about.

    Parameters
    ----------
    kind : "hall", "storey" or "block"
    mesh : all surfaces
    floor : the ground and what of it is taken
    """

    kind: str
    mesh: Mesh
    floor: Floor

    @cached_property
    def caster(self) -> Caster:
        """The mesh ready for rays; built at the first use."""
        return Caster(self.mesh)

    @cached_property
    def walkable(self) -> NDArray[np.bool_]:
        """(nx, ny) cells of the floor's grid that are clear and hang together."""
        clear = ndimage.distance_transform_edt(np.pad(~self.floor.claimed, 1))[1:-1, 1:-1]
        parts, n = ndimage.label(clear * self.floor.cell >= CLEARANCE)
        if n == 0:
            return np.asarray(clear == clear.max())
        sizes = np.bincount(parts.ravel())[1:]
        return np.asarray(parts == 1 + int(sizes.argmax()))
