"""The grid over the four invariants of a pair: where its bins lie.

layout  --bin_centres-->  invariants (B, 4)
layout  --bin_edges-->    edges, in coordinates that are cheap to compute
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.properties import PropertyParameters
from sceneprint.types import Floats, Ints32


@dataclass(frozen=True)
class TableLayout:
    """The grid over the four invariants of a pair.

    Angular bins are centred on right angles (and the dihedral ones on 0 and 180 degrees):
    buildings are full of these, and they must not fall on the edge between two bins. With 27
    of them the tolerance of 10 degrees in Eq. (1) is an edge, so that no bin straddles the jump
    of the robust sign; a third of the bins then serve as well as a finer grid without that.
    """

    distance_bins: int = 20
    angle_bins: int = 27  #: of each normal's angle to r; odd, so that one is centred on 90
    dihedral_bins: int = 20  #: a multiple of 4, offset by half a bin
    distance_exponent: float = 1.3  #: distance edges are radius * (i / bins)^exponent

    @property
    def n_bins(self) -> int:
        """B, the number of bins."""
        return self.distance_bins * self.angle_bins**2 * self.dihedral_bins


def bin_centres(layout: TableLayout, first: int, last: int, p: PropertyParameters) -> Floats:
    """The four invariants at the centres of bins `first` to `last` - 1.

    Returns
    -------
    (last - first, 4) : as `properties.invariants`: metres, rad
    """
    shape = (layout.distance_bins, layout.angle_bins, layout.angle_bins, layout.dihedral_bins)
    i, j, k, m = np.unravel_index(np.arange(first, last), shape)
    d = p.radius * ((i + 0.5) / layout.distance_bins) ** layout.distance_exponent
    theta = np.pi * (np.stack([j, k]) + 0.5) / layout.angle_bins
    phi = 2 * np.pi * m / layout.dihedral_bins
    return np.column_stack([d, theta[0], theta[1], np.where(phi > np.pi, phi - 2 * np.pi, phi)])


def _diamond(x: Floats, y: Floats) -> Floats:
    """Monotone stand-in for the angle atan2(y, x), in [0, 4): a division, no arctangent."""
    t = y / (np.abs(x) + np.abs(y))
    diamond: Floats = np.where(x < 0, 2.0 - t, np.where(y < 0, 4.0 + t, t))
    return diamond


def bin_edges(layout: TableLayout, p: PropertyParameters) -> tuple[Floats, Floats, Floats]:
    """Upper edges of the bins, in the coordinates in which `count_pairs` looks them up.

    Returns
    -------
    distance : (distance_bins,) metres
    angle : (angle_bins,) minus the cosine of the angle, rising from -1; the last is infinite
    dihedral : (dihedral_bins + 1,) diamond angle in [0, 4]; the last bin is the first's half
    """
    distance = p.radius * (np.arange(1, layout.distance_bins + 1) / layout.distance_bins) ** (
        layout.distance_exponent
    )
    angle = -np.cos(np.pi * np.arange(1, layout.angle_bins + 1) / layout.angle_bins)
    angle[-1] = np.inf  # a cosine may exceed 1 by a rounding
    phi = 2 * np.pi * (np.arange(layout.dihedral_bins) + 0.5) / layout.dihedral_bins
    dihedral = np.append(_diamond(np.cos(phi), np.sin(phi)), 4.0)
    return distance, angle, dihedral


def hints(edges: Floats, origin: float, extent: float, n: int = 4096) -> Ints32:
    """Where to begin the search for a bin: for each of `n` equal cells, its first bin.

    Parameters
    ----------
    edges : upper edges of the bins
    origin, extent : of the coordinate
    n : cells; each must be narrower than any bin

    Raises
    ------
    ValueError : a bin is narrower than a cell.
    """
    if n * np.diff(edges, prepend=origin).min() <= extent:
        raise ValueError("bins are finer than the look-up allows: use fewer")
    starts = origin + extent * np.arange(n) / n
    return np.minimum(np.searchsorted(edges, starts, side="right"), len(edges) - 1).astype(np.int32)
