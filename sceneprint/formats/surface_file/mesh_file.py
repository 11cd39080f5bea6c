"""Reading of OBJ, STL and glTF files with trimesh; only this module imports trimesh.

bytes, format  --read_mesh-->  vertices, triangles

The reader uses only the bytes: it rejects files whose geometry is in other files, and ignores
materials and textures.
"""

from __future__ import annotations

import io
import json
import logging
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

import numpy as np

from sceneprint.errors import MissingDependency, UnreadableCloud
from sceneprint.formats.points.rows import BLOCK, FileBytes
from sceneprint.formats.surface_file.ply_faces import check_triangles
from sceneprint.formats.surface_file.raw_surface import MOST_FILE_POINTS, MOST_VERTICES
from sceneprint.types import Floats, Ints32

MeshFormat = Literal["obj", "stl", "glb", "gltf"]

_AGAIN = "Copy or write the file again."
_GLB_HEADER, _JSON_CHUNK = 20, 0x4E4F534A
#: Maximum size of the JSON of a glTF file without its embedded buffers, bytes.
_MOST_JSON = 64 << 20
#: Prefixes of required extensions that do not affect positions.
_HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_", "EXT_lights_")


@dataclass(frozen=True, eq=False)
class FileMesh:
    """The geometry of a file, in the axes of its scene.

    Parameters
    ----------
    vertices : (N, 3) float64, units of the file
    triangles : (M, 3) int32 indices, -1 for invalid indices; None if the file has no triangles
    notes : sentences for users on omitted parts
    """

    vertices: Floats
    triangles: Ints32 | None
    notes: tuple[str, ...] = ()

    def blocks(self) -> Iterator[Floats]:
        """Yield the vertices in blocks (n, 3)."""
        for first in range(0, len(self.vertices), BLOCK):
            yield self.vertices[first : first + BLOCK]


def read_mesh(data: FileBytes, file_format: MeshFormat) -> FileMesh:
    """Read the vertices and triangles of all parts of a file.

    Raise UnreadableCloud if the file is damaged, has no geometry or too much, or needs other files
    or unsupported extensions. Raise MissingDependency if trimesh is not installed.
    """
    trimesh = _import_trimesh()
    name = {"glb": "glTF", "gltf": "glTF"}.get(file_format, file_format.upper())
    if file_format in ("glb", "gltf"):
        _check_gltf(_read_gltf_json(data, file_format))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # numpy issues only a warning if text ends within an array
            warnings.simplefilter("error", DeprecationWarning)
            scene = trimesh.load_scene(
                io.BytesIO(data), file_type=file_format, process=False, validate=False,
                skip_materials=True, maintain_order=True,
            )  # fmt: skip
            return _join_parts(trimesh, scene, name)
    except (MemoryError, UnreadableCloud):
        raise
    except Exception as cause:  # trimesh raises arbitrary exceptions for damaged files
        raise UnreadableCloud(
            f"The {name} file cannot be read ({type(cause).__name__}: {str(cause)[:120]}). {_AGAIN}"
        ) from cause


def _import_trimesh() -> ModuleType:
    try:
        import trimesh
    except ImportError as cause:
        raise MissingDependency(
            "OBJ, STL and glTF require the package trimesh, which is not installed. Install it "
            "(pip install trimesh), or write the surface as PLY."
        ) from cause
    logging.getLogger("trimesh").disabled = True  # it logs long messages for damaged files
    module: ModuleType = trimesh
    return module


def _join_parts(trimesh: ModuleType, scene: Any, name: str) -> FileMesh:
    """Return all triangles of a scene, or all points if it has no triangles.

    Raise UnreadableCloud if the scene has neither, or exceeds the limits.
    """
    parts = []
    for node in scene.graph.nodes_geometry:
        T, key = scene.graph[node]
        parts.append((scene.geometry[key], np.asarray(T, np.float64)))
    meshes = [
        (part, T) for part, T in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)
    ]
    clouds = [(part, T) for part, T in parts if isinstance(part, trimesh.PointCloud)]
    clouds += [(part, T) for part, T in parts if isinstance(part, trimesh.Trimesh)]
    chosen = meshes or clouds
    count = sum(len(part.vertices) for part, _ in chosen)
    if not count:
        raise UnreadableCloud(
            f"The {name} file has neither triangles nor points. Export the geometry again, and "
            "check it in another program."
        )
    most = MOST_VERTICES if meshes else MOST_FILE_POINTS
    if count > most:
        raise UnreadableCloud(
            f"The {name} file has {count} vertices; the limit is {most}. Simplify the mesh, or "
            "write only its vertices, as a cloud."
        )
    check_triangles(sum(len(part.faces) for part, _ in meshes))
    vertices = np.concatenate(
        [np.asarray(part.vertices, np.float64) @ T[:3, :3].T + T[:3, 3] for part, T in chosen]
    )
    omitted = len(parts) - len(chosen)
    notes = (f"{omitted} parts without triangles were skipped.",) if omitted else ()
    if not meshes:
        return FileMesh(vertices, None, notes)
    triangles, first = list[Ints32](), 0
    for part, T in meshes:
        faces = np.asarray(part.faces, np.int64)
        n = len(part.vertices)
        if np.linalg.det(T[:3, :3]) < 0:  # a reflection reverses the orientation of triangles
            faces = faces[:, ::-1]
        triangles.append(np.where((faces < 0) | (faces >= n), -1, faces + first).astype(np.int32))
        first += n
    return FileMesh(vertices, np.concatenate(triangles), notes)


def _read_gltf_json(data: FileBytes, file_format: str) -> dict[str, Any]:
    """Return the JSON object of a glTF file; raise UnreadableCloud if it is damaged."""
    length = 0
    if file_format == "glb":
        if len(data) < _GLB_HEADER:
            raise UnreadableCloud(f"The glTF file ends within its header. {_AGAIN}")
        _, version, total, length, kind = struct.unpack_from("<5I", data)
        if version != 2 or kind != _JSON_CHUNK or not 0 < length <= _MOST_JSON:
            raise UnreadableCloud(
                f"The glTF file has version {version} and a description of {length} bytes, or "
                "does not start with a description. Write it as glTF 2.0."
            )
        if total > len(data):
            raise UnreadableCloud(
                f"The glTF header declares {total} bytes, but the file has {len(data)}. {_AGAIN}"
            )
    try:
        fields = json.loads(data[_GLB_HEADER : _GLB_HEADER + length] if length else data[:])
    except (ValueError, RecursionError) as cause:
        raise UnreadableCloud(f"The glTF file is not JSON ({str(cause)[:80]}). {_AGAIN}") from cause
    if not isinstance(fields, dict):
        raise UnreadableCloud(f"The glTF file is not a JSON object. {_AGAIN}")
    return fields


def _check_gltf(fields: dict[str, Any]) -> None:
    """Raise UnreadableCloud if a buffer is in another file, a required extension may affect
    positions, or an accessor is sparse or has no buffer view.
    """
    for buffer in _list_objects(fields, "buffers"):
        uri = buffer.get("uri")
        if uri is not None and not str(uri)[:100].startswith("data:"):
            raise UnreadableCloud(
                f"The geometry of the glTF file is in another file, {str(uri)!r:.80}. Export a "
                "single GLB file."
            )
    required = fields.get("extensionsRequired", [])
    unknown = [str(extension) for extension in required if not str(extension).startswith(_HARMLESS)]
    if unknown:
        raise UnreadableCloud(
            f"The glTF file needs the extension {unknown[0]!r:.60}, which is not supported. Export "
            "it without compression or quantisation."
        )
    for accessor in _list_objects(fields, "accessors"):
        if "sparse" in accessor or "bufferView" not in accessor:
            raise UnreadableCloud(
                "The glTF file has sparse accessors, or accessors without a buffer view, which are "
                "not supported. Export the file again without them."
            )


def _list_objects(fields: dict[str, Any], key: str) -> list[dict[str, Any]]:
    objects = fields.get(key, [])
    if not isinstance(objects, list) or not all(isinstance(item, dict) for item in objects):
        raise UnreadableCloud(f"The glTF file has no list of objects as its {key}. {_AGAIN}")
    return objects
