"""A spinning laser scanner: a mesh and a pose to a cloud.

Caster, T_world_sensor (4, 4), Spinning, rng  --scan-->  points (N, 3) in the sensor's frame
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sceneprint.synth.rays import Caster
from sceneprint.types import Floats, Floats32


@dataclass(frozen=True)
class Spinning:
    """A scanner that turns about its z axis, and what it gets wrong.

    Parameters
    ----------
    rings : lasers, one above the other
    lowest, highest : elevation of the first and of the last, rad
    azimuth_step : rad from one firing to the next
    minimum, maximum : range, metres
    sigma : noise of a range, metres
    ring_sigma : offset that all ranges of a ring share, metres
    loss : share of returns that are lost anyhow
    grazing : cosine of incidence at which half of the returns of the farthest surface are lost
    blind_middle, blind_width : azimuths that the carrier hides, rad
    blind_below : elevation below which it hides them, rad
    """

    rings: int = 64
    lowest: float = math.radians(-22.5)
    highest: float = math.radians(22.5)
    azimuth_step: float = math.radians(0.35)
    minimum: float = 0.5
    maximum: float = 80.0
    sigma: float = 0.02
    ring_sigma: float = 0.005
    loss: float = 0.01
    grazing: float = 0.1
    blind_middle: float = math.pi
    blind_width: float = math.radians(60.0)
    blind_below: float = math.radians(-5.0)

    @property
    def elevations(self) -> Floats:
        """(rings,) rad, from the lowest up."""
        return np.linspace(self.lowest, self.highest, self.rings)


def own_scanner(rng: np.random.Generator) -> Spinning:
    """A scanner as there are many: 16 to 128 rings, narrow or tall, near- or far-sighted."""
    rings = int(rng.choice((16, 32, 64, 64, 96, 128)))
    low, high = np.radians(rng.uniform((-45.0, 8.0), (-14.0, 45.0)))
    if rings < 64:  # few rings are never far apart
        low, high = max(low, -rings * 0.018), min(high, rings * 0.018)
    # the more rings, the coarser: scanners of many rings have tens of thousands of points as well
    step = math.radians(rng.uniform(0.18, 0.4)) * (1.0 if rings <= 64 else 1.6)
    return Spinning(
        rings=rings,
        lowest=float(low),
        highest=float(high),
        azimuth_step=step,
        minimum=float(rng.uniform(0.4, 1.2)),
        maximum=float(rng.uniform(45.0, 100.0)),
        sigma=float(rng.uniform(0.01, 0.03)),
        ring_sigma=float(rng.uniform(0.0, 0.015)),
        loss=float(rng.uniform(0.0, 0.05)),
        grazing=float(rng.uniform(0.03, 0.2)),
        blind_middle=float(rng.uniform(-math.pi, math.pi)),
        blind_width=float(rng.choice((0.0, rng.uniform(0.2, 1.8)))),
        blind_below=float(rng.uniform(-0.3, 0.6)),
    )


def rays_of(sensor: Spinning) -> tuple[Floats32, Floats32]:
    """Directions (rings x firings, 3), ring by ring, and azimuths (firings,) rad from -pi on."""
    n = round(2 * math.pi / sensor.azimuth_step)
    azimuth = (np.arange(n) * (2 * math.pi / n) - math.pi).astype(np.float32)
    elevation = sensor.elevations.astype(np.float32)[:, None]
    c = np.cos(elevation)
    rays = np.empty((sensor.rings, n, 3), np.float32)
    rays[..., 0] = c * np.cos(azimuth)
    rays[..., 1] = c * np.sin(azimuth)
    rays[..., 2] = np.sin(elevation)
    return rays.reshape(-1, 3), azimuth


def scan(
    caster: Caster, T_world_sensor: Floats, sensor: Spinning, rng: np.random.Generator
) -> Floats32:
    """One turn of the scanner, standing still.

    Parameters
    ----------
    caster : the scene, metres
    T_world_sensor : (4, 4) pose
    sensor : see Spinning
    rng : of noise and losses

    Returns
    -------
    (N, 3) float32, metres, sensor frame: what came back, ring by ring
    """
    rays, azimuth = rays_of(sensor)
    turned = rays @ T_world_sensor[:3, :3].T.astype(np.float32)
    origins = np.broadcast_to(T_world_sensor[:3, 3].astype(np.float32), turned.shape)
    hits = caster.cast(origins, turned)
    distance = hits.distance
    cosine = np.abs(np.einsum("ij,ij->i", turned, hits.normal))
    # a return is lost the sooner the farther off and the more grazing its surface is
    far = np.minimum(distance / np.float32(sensor.maximum), 1.0)
    held = 1 - 0.5 ** (cosine / (sensor.grazing * far + 1e-6))
    held *= (1 - sensor.loss) * (1 - np.append(caster.mesh.loss, np.float32(0))[hits.face])
    noise = rng.normal(0, sensor.sigma, len(rays)).astype(np.float32)
    rings = np.repeat(rng.normal(0, sensor.ring_sigma, sensor.rings), len(azimuth))
    measured = distance + noise + rings.astype(np.float32)
    kept = (hits.face >= 0) & (rng.random(len(rays)) < held)
    kept &= (measured >= sensor.minimum) & (measured <= sensor.maximum)
    away = np.abs((azimuth - sensor.blind_middle + math.pi) % (2 * math.pi) - math.pi)
    hidden = (away < sensor.blind_width / 2) & (sensor.elevations < sensor.blind_below)[:, None]
    kept &= ~hidden.ravel()
    return np.asarray(rays[kept] * measured[kept, None], np.float32)
