"""From a seed to the scans of a spinning laser in a hall, a storey or a block.

seed, index  --synthesise_survey-->  Survey: clouds with poses
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sceneprint.synth.blocks import make_block
from sceneprint.synth.halls import make_hall
from sceneprint.synth.premises import Premises
from sceneprint.synth.rounds import scattered, walk
from sceneprint.synth.spinning import Spinning, own_scanner, scan
from sceneprint.synth.storeys import make_storey
from sceneprint.types import Cloud

LEAST_POINTS = 2000  #: of a scan; a scattered one of fewer is taken elsewhere
_TRIES = 5

_MAKERS = {"hall": make_hall, "storey": make_storey, "block": make_block}
#: kinds in the order of indices: of five sites two are halls, two storeys and one is a block
_ORDER = ("hall", "storey", "hall", "block", "storey")


@dataclass(frozen=True, eq=False)
class Survey:
    """The scans of one synthetic site.

    Parameters
    ----------
    name : "site-000" and so on
    kind : "hall", "storey" or "block"
    sensor : what took them
    clouds : sensor frame; pose is T_world_sensor
    """

    name: str
    kind: str
    sensor: Spinning
    clouds: tuple[Cloud, ...]


def synthesise_survey(
    seed: int,
    index: int,
    views: int,
    *,
    along_path: bool = False,
    kind: str | None = None,
    sensor: Spinning | None = None,
    perfect: bool = False,
) -> Survey:
    """Build a site and scan it.

    The outcome depends on the arguments only, so sites can be made in any order and in any
    process.

    Parameters
    ----------
    seed, index : the site is number `index` of the collection `seed`
    views : how many scans
    along_path : whether they follow one walk, 1.5 m apart; else they are independent
    kind : "hall", "storey" or "block"; default: by the index
    sensor : default: one of its own for each site
    perfect : whether it makes no errors and loses nothing

    Raises
    ------
    MissingDependency : Embree cannot be imported.
    """
    premises, rng = premises_and_rng(seed, index, kind)
    drawn = own_scanner(rng)
    sensor = sensor or drawn
    if perfect:
        sensor = replace(sensor, sigma=0.0, ring_sigma=0.0, loss=0.0, grazing=0.0, blind_width=0.0)
    name, clouds = f"site-{index:03d}", []
    poses = walk(premises, views, rng) if along_path else scattered(premises, views, rng)
    for number, first in enumerate(poses):
        T, tries = first, 1
        points = scan(premises.caster, T, sensor, rng)
        while len(points) < LEAST_POINTS and tries < _TRIES and not along_path:
            T, tries = scattered(premises, 1, rng)[0], tries + 1
            points = scan(premises.caster, T, sensor, rng)
        clouds.append(Cloud(points, name=f"{name}/scan-{number:06d}", pose=T))
    return Survey(name, premises.kind, sensor, tuple(clouds))


def premises_and_rng(
    seed: int, index: int, kind: str | None = None
) -> tuple[Premises, np.random.Generator]:
    """Site number `index` of collection `seed`, and the generator as it stands after it."""
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 1)))
    return _MAKERS[kind or _ORDER[index % len(_ORDER)]](rng), rng
