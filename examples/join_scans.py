"""Join scans with poses to one cloud, like the SLAM system of a robot.

    python examples/join_scans.py site/site-000 hall.pcd --every 2

The program reads scans `NAME.ply` with their `NAME.pose.txt`, and writes one point per voxel of
10 cm to a PCD file. `--every 2` uses every second scan, so that the others remain for queries.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sceneprint.formats.points.cloud import decode_cloud

#: Edge length of a voxel, metres.
VOXEL_M = 0.1


def main() -> None:
    """Write the map."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scans", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1)
    options = parser.parse_args()
    parts = []
    for path in sorted(options.scans.glob("*.ply"))[:: options.every]:
        T_map_sensor = np.loadtxt(path.with_suffix(".pose.txt"))
        points = decode_cloud(path.read_bytes(), file_format="ply").points
        parts.append(points @ T_map_sensor[:3, :3].T + T_map_sensor[:3, 3])
    points = np.concatenate(parts).astype("<f4")
    _, first = np.unique(np.floor(points / VOXEL_M).astype(int), axis=0, return_index=True)
    points = points[np.sort(first)]
    n = len(points)
    header = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    options.out.write_bytes(header.encode() + points.tobytes())
    print(f"{options.out}: {n} points of {len(parts)} scans")


if __name__ == "__main__":
    main()
