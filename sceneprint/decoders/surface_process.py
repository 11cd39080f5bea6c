"""Program of a process that reads the file of a whole map.

    python -m sceneprint.decoders.surface_process CONTROL PARENT BYTES kernels FILE FORMAT

Before its confinement, the process maps FILE into memory and loads the reader of FORMAT. See
child_process.py.
"""

from __future__ import annotations

import base64
import json
import struct
import sys
from contextlib import suppress
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from sceneprint.decoders.child_process import (
    array_samples,
    end_compilation,
    mapped,
    serve,
    text_samples,
)
from sceneprint.errors import SceneprintError
from sceneprint.formats.points import pcd, ply, rows
from sceneprint.formats.points.cloud import thinned
from sceneprint.formats.surface_file import ply_faces
from sceneprint.formats.surface_file.reading import SurfaceFormat, SurfaceOptions, read_surface
from sceneprint.geometry.surface.upright import estimate_up


def _main() -> None:
    file, form = mapped(int(sys.argv[5])), cast(SurfaceFormat, sys.argv[6])

    def surface(
        _data: bytes, request: dict[str, Any]
    ) -> tuple[dict[str, Any], tuple[NDArray[Any], ...]]:
        stated = SurfaceOptions(request["units_per_metre"], request["up"])
        read = read_surface(file, request["name"], stated, form)
        points, triangles = read.surface.points, read.surface.triangles
        reply = {
            "points": len(points), "triangles": None if triangles is None else len(triangles),
            "offset": read.surface.offset.tolist(), "up": read.surface.up.tolist(),
            "units": read.units, "up_from": read.up_from, "notes": list(read.notes),
            "units_per_metre": read.units_per_metre, "file_points": read.file_points,
            "voxel": read.voxel,
        }  # fmt: skip
        return reply, (points,) if triangles is None else (points, triangles)

    serve({"surface": surface}, lambda _: _load(form))


# A confined process can neither import nor compile, so all code runs once before confinement.


def _load(form: SurfaceFormat) -> None:
    """Load the reader of a format: read a sample of each variant."""
    points = np.ones((20, 3), np.float32)
    thinned(points, 8)
    estimate_up(points, None, np.array([0.0, 0.0, 1.0]))
    ElementTree.fromstring("<a/>")
    for data, sample_format in (*array_samples(), *text_samples(), *mesh_samples()):
        if sample_format == form:
            with suppress(SceneprintError):  # an optional reader is absent, or a sample has no mesh
                read_surface(data, "", None, form)
    end_compilation(rows, pcd, ply, ply_faces)


def mesh_samples() -> list[tuple[bytes, Any]]:
    """Return (content, format) of a sample for each variant of each mesh format."""
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
    head = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    text = "".join(f"{x} {y} {z}\n" for x, y, z in corners)
    samples: list[tuple[bytes, Any]] = [
        (f"ply\nformat ascii 1.0\n{head}{text}4 0 1 3 2\n".encode(), "ply")
    ]
    for sign, order in (("<", "little"), (">", "big")):
        body = np.array(corners, f"{sign}f4").tobytes() + struct.pack(f"{sign}B3i", 3, 0, 1, 2)
        samples.append((f"ply\nformat binary_{order}_endian 1.0\n{head}".encode() + body, "ply"))
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "vn 0 0 1\nvt 0 0\n"
    ways = ("f 1 2 3\nf 1 2 4 3\n", "f 1/1/1 2/1/1 3/1/1\n", "f 1//1 2//1 4//1 3//1\n", "")
    samples += [(f"mtllib a\n{lines}usemtl b\n{faces}".encode(), "obj") for faces in ways]
    soup = np.zeros((50,), np.uint8)
    soup[:48] = np.array([(0, 0, 1), *corners[:3]], "<f4").view(np.uint8).reshape(-1)
    samples.append((bytes(80) + struct.pack("<I", 1) + soup.tobytes(), "stl"))
    vertices = "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners[:3])
    solid = f"solid a\nfacet normal 0 0 1\nouter loop\n{vertices}endloop\nendfacet\nendsolid a\n"
    samples += [(solid.encode(), "stl"), (b"solid broken", "stl"), (_gltf(corners), "gltf")]
    return [*samples, (_glb(json.loads(_gltf(corners))), "glb")]


def _gltf(corners: list[tuple[int, int, int]]) -> bytes:
    """Return a JSON glTF file with points, lines, and triangles with and without indices."""
    body = np.array(corners[:3], "<f4").tobytes() + struct.pack("<3I", 0, 1, 2)
    uri = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    position = {"POSITION": 0}
    primitives: list[dict[str, Any]] = [{"attributes": position, "indices": 1}]
    primitives += [{"attributes": position, "mode": mode} for mode in (0, 1, 4, 5)]
    turned = {"rotation": [0, 0, 0, 1], "translation": [0, 0, 1], "scale": [1, 1, 1]}
    return json.dumps({
        "asset": {"version": "2.0"},
        "buffers": [{"uri": uri, "byteLength": 48}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36, "byteStride": 12},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": primitives}],
        "nodes": [{"children": [1]}, {"mesh": 0, **turned}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }).encode()  # fmt: skip


def _glb(tree: dict[str, Any]) -> bytes:
    body = base64.b64decode(tree["buffers"][0].pop("uri").partition(",")[2])
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


if __name__ == "__main__":
    _main()
