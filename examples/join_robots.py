"""Join the recordings of two robots with unknown relative origins into one map.

    python examples/join_robots.py drives/mapping drives/later

Both recordings go into one map as two sessions. Each frame of the second session is queried among
those of the first, and the matches vote for the transform between the parent frames. `--url` uses a
service; without it everything runs in this process, and nothing is stored.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from sceneprint.errors import MapExists
from sceneprint.formats.dataset import find_sequences
from sceneprint.types import Floats
from sceneprint_client import Client
from sceneprint_client.api.sessions import Association, Join
from sceneprint_client.frame_files import meta_of

MAP = "two-robots"


def upload(client: Client, bag: Path) -> str:
    """Upload the keyframes of a recording, wait until they are signed, and return their session."""
    sequence, *others = find_sequences(bag)
    if others:
        raise SystemExit(f"{bag}: Its stamps go back. Split it there, and specify a part.")
    print(f"{bag}: {sequence.note}")
    named = {"session": sequence.name, "parent_frame": sequence.parent_frame}
    added = [client.upload(MAP, one, meta_of(one, **named)) for one in sequence.frames]
    client.wait([one.job_id for one in added])
    return sequence.name


def join(client: Client, bags: tuple[Path, Path]) -> Floats | None:
    """Upload both recordings and associate them; return T_first_second (4, 4) or None."""
    try:
        client.create_map(MAP, "Example: two robots in one room", model="depth")
    except MapExists:
        print(f"using the existing map {MAP}")
    first, second = (upload(client, bag) for bag in bags)
    found = client.compute(Association, MAP, sessions=[second, first])
    if found.result is None:
        print(f"the association is {found.state}: {found.error}")
        return None
    result = found.result
    print(f"{result.edges} pairs of frames show one place; {result.inconsistent} were outvoted")
    for one in result.joins:  # a join for each pair of parent frames
        T_first_second = print_join(one)
        if T_first_second is not None:
            return T_first_second
    print("not enough overlap: drive the second robot along the path of the first")
    return None


def print_join(one: Join) -> Floats | None:
    """Print the transform between two parent frames and its uncertainty."""
    if one.transform is None:
        print(f"{one.from_parent} is not joined to {one.to_parent}: {one.reason}")
        return None
    T = np.array(one.transform.matrix)
    yaw, tilt = np.degrees([np.arctan2(T[1, 0], T[0, 0]), np.arccos(np.clip(T[2, 2], -1, 1))])
    x, y, z = T[:3, 3]
    print(f"{one.from_parent} begins in {one.to_parent} at {x:.3f} {y:.3f} {z:.3f} m")
    print(f"  turned by {yaw:.1f} deg, tilted by {tilt:.1f} deg")
    spread = f"{100 * (one.spread_m or 0.0):.1f} cm, {one.spread_deg:.1f} deg"
    print(f"  {one.strength}: {one.support} of {one.votes} pairs agree, to {spread}")
    if one.strength == "weak":
        print("  check it before you rely on it: the pairs are few, or all from one place")
    return T


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("bags", type=Path, nargs=2, help="recording of each robot")
    parser.add_argument("--url", help="address of a service")
    parser.add_argument("--key", help="key of the service, if it requires one")
    parser.add_argument("--data", help="folder to store the map in, without a service")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as scratch,
        Client(options.url, options.key)
        if options.url
        else Client.embedded(options.data or scratch) as client,
    ):
        join(client, tuple(options.bags))


if __name__ == "__main__":
    main()
