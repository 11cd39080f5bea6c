"""The maps of two robots become one: two recordings of one place, neither knows the other's origin.

    python examples/join_robots.py drives/mapping drives/later

Both go into one map, a session each. Each frame of the second is looked up among those of the
first, and what is found votes on how the second's parent frame lies in the first's. `--url` takes a
service; without it all happens in this process, and nothing is kept.
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
    """Upload the keyframes of a recording, and wait until they are signed; their session."""
    sequence, *others = find_sequences(bag)
    if others:
        raise SystemExit(f"{bag}: its stamps go back. Cut it there, and name one of the parts.")
    print(f"{bag}: {sequence.note}")
    named = {"session": sequence.name, "parent_frame": sequence.parent_frame}
    added = [client.upload(MAP, one, meta_of(one, **named)) for one in sequence.frames]
    client.wait([one.job_id for one in added])
    return sequence.name


def join(client: Client, bags: tuple[Path, Path]) -> Floats | None:
    """Upload both, and associate them: T_first_second (4, 4), None where they do not agree."""
    try:
        client.create_map(MAP, "Example: two robots in one room", model="depth")
    except MapExists:
        print(f"map {MAP} is there already, and is used")
    first, second = (upload(client, bag) for bag in bags)
    found = client.compute(Association, MAP, sessions=[second, first])
    if found.result is None:
        print(f"the association is {found.state}: {found.error}")
        return None
    told = found.result
    print(f"{told.edges} pairs of frames are of one place; {told.inconsistent} were outvoted")
    for one in told.joins:  # one for each pair of parent frames
        T_first_second = tell(one)
        if T_first_second is not None:
            return T_first_second
    print("the recordings do not share enough: drive the second robot where the first has been")
    return None


def tell(one: Join) -> Floats | None:
    """Print how one parent frame lies in the other, and how sure that is."""
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
        print("  look at it before you rely on it: few pairs, or of one place alone")
    return T


def main() -> None:
    """The example as a command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("bags", type=Path, nargs=2, help="recording of each robot")
    parser.add_argument("--url", help="of a service")
    parser.add_argument("--key", help="where it asks for one")
    parser.add_argument("--data", help="folder to keep the map in, without a service")
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
