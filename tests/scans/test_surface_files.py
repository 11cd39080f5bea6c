"""Tests of whole maps from other programs, and of damaged and hostile files."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud, UselessFrame
from sceneprint.formats.depth_file import encode_npy
from sceneprint.formats.surface_file.raw_surface import gather
from sceneprint.formats.surface_file.reading import SurfaceOptions, read_surface

Points = NDArray[np.float64]
N = 30_001
MILLIMETRE = 1e-3
STATED = SurfaceOptions(units_per_metre=1.0, up="z")


def path(n=N):
    """Points of a walk through a hall, not all of whose coordinates float32 holds exactly."""
    return np.cumsum(np.random.default_rng(1).normal(0, 0.05, (n, 3)), axis=0)


def steps():
    """Three boxes in a row, each higher than the one before."""
    boxes = [trimesh.creation.box((1, 1, k + 1)) for k in range(3)]
    for k, box in enumerate(boxes):
        box.apply_translation((k * 1.5, 0.25, (k + 1) / 2))
    return trimesh.util.concatenate(boxes)


def corners(surface):
    """Coordinates (M, 9) of each triangle in the file's frame, in an order of their own."""
    assert surface.triangles is not None
    return sorted_rows((surface.points.astype(np.float64) + surface.offset)[surface.triangles])


def sorted_rows(triangles):
    """Rows (M, 9) from triangles (M, 3, 3), each turned to begin with its least corner."""
    rows = []
    for one in np.round(triangles, 4).tolist():
        first = one.index(min(one))
        rows.append([*one[first], *one[first - 2], *one[first - 1]])
    return np.array(sorted(rows))


def exported(mesh, form):
    if form != "gltf":
        data = mesh.export(file_type=form)
        return data.encode() if isinstance(data, str) else bytes(data)
    files = mesh.export(file_type="gltf")
    tree = json.loads(files["model.gltf"])
    for buffer in tree["buffers"]:
        text = base64.b64encode(files[buffer["uri"]]).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{text}"
    return json.dumps(tree).encode()


# Clouds.


def test_scans_by_libe57_are_one_cloud(tmp_path):
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed")
    file = tmp_path / "map.e57"
    places = [(500_000.0, 2.0, 3.0), (500_010.0, -2.0, 3.0)]
    with pye57.E57(str(file), "w") as writer:
        for place in places:
            columns = {f"cartesian{axis}": path()[:, k].copy() for k, axis in enumerate("XYZ")}
            half = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # a quarter turn about z
            writer.write_scan_raw(columns, rotation=half, translation=np.array(place))
    read = read_surface(file.read_bytes(), file.name)
    x, y, z = path().T
    expected = np.concatenate([np.stack([-y, x, z], axis=1) + place for place in places])
    there = read.surface.points.astype(np.float64) + read.surface.offset
    np.testing.assert_allclose(there, expected, atol=MILLIMETRE)
    assert (read.units, read.file_points) == ("file", 2 * N)


def test_rows_of_numpy_and_what_is_missing():
    points = path()
    points[5] = np.nan
    read = read_surface(encode_npy(points), "map.npy", STATED)
    assert (read.units, read.up_from) == ("stated", "stated")
    np.testing.assert_allclose(read.surface.points, np.delete(points, 5, axis=0), atol=MILLIMETRE)
    assert read.notes == ("1 missing points were skipped.",)


def test_stated_units_and_up(pcd, points):
    read = read_surface(pcd(), "map.pcd", SurfaceOptions(units_per_metre=0.5, up="-y"))
    np.testing.assert_allclose(read.surface.points, points * 2, atol=1e-6)
    np.testing.assert_array_equal(read.surface.up, [0, -1, 0])
    for wrong in ({"units_per_metre": 0.0}, {"units_per_metre": np.nan}, {"up": "w"}):
        with pytest.raises(UnreadableCloud, match="Specify"):
            SurfaceOptions(**wrong)


def las_with(record, body):
    """A LAS file of twelve points with a record that describes its coordinates."""
    vlr = struct.pack("<2x16sHH32x", b"LASF_Projection", record, len(body)) + body
    header = bytearray(227)
    header[:4], header[24:26] = b"LASF", bytes([1, 2])
    struct.pack_into("<HII", header, 94, 227, 227 + len(vlr), 1)
    struct.pack_into("<BHI", header, 104, 0, 20, 12)
    struct.pack_into("<6d", header, 131, 1, 1, 1, 0, 0, 0)
    rows = b"".join(struct.pack("<iii8x", k, 2 * k, 3 * k) for k in range(12))
    return bytes(header) + vlr + rows


def keys(*pairs):
    body = struct.pack("<4H", 1, 1, 0, len(pairs))
    return body + b"".join(struct.pack("<4H", key, 0, 1, value) for key, value in pairs)


FEET_WKT = (
    b'PROJCS["x",GEOGCS["y",DATUM["d",SPHEROID["s",6378137,298.25]],UNIT["degree",0.0174]],'
    b'UNIT["US survey foot",0.3048006096012192]]'
)


@pytest.mark.parametrize(
    ("record", "body", "units"),
    [
        (34735, keys((1024, 1), (3076, 9001)), 1.0),
        (34735, keys((1024, 1), (3076, 9002)), 1 / 0.3048),
        (2112, FEET_WKT, 1 / 0.3048006096012192),
    ],
)
def test_units_of_a_las_file(record, body, units):
    read = read_surface(las_with(record, body), "map.las")
    assert (read.units, read.up_from) == ("file", "file")
    assert read.units_per_metre == pytest.approx(units)
    np.testing.assert_allclose(read.surface.points[1] * units, [1, 2, 3], rtol=1e-6)
    stated = read_surface(las_with(record, body), "map.las", SurfaceOptions(units_per_metre=2.0))
    assert (stated.units, stated.units_per_metre) == ("stated", 2.0)


@pytest.mark.parametrize(
    ("record", "body"), [(34735, keys((1024, 2))), (2112, b'GEOGCS["WGS 84",UNIT["degree",1]]')]
)
def test_degrees_are_refused(record, body):
    with pytest.raises(UnreadableCloud, match=r"map\.las: .*degrees.*Convert them to metres"):
        read_surface(las_with(record, body), "map.las")


# Meshes.


@pytest.mark.parametrize(
    ("form", "name"),
    [
        ("ply", "a.ply"), ("obj", "a.obj"), ("stl", "a.bin"), ("stl_ascii", "a.stl"),
        ("glb", "a.dat"), ("gltf", "a.gltf"),
    ],
)  # fmt: skip
def test_meshes_by_trimesh(form, name):
    mesh = steps()
    mesh.apply_translation((0.123456, 5.5, -2))
    read = read_surface(exported(mesh, form), name)
    np.testing.assert_allclose(corners(read.surface), sorted_rows(mesh.triangles), atol=MILLIMETRE)
    source = "file" if form in ("glb", "gltf") else "estimated"
    assert (read.units, read.up_from) == (source, source)
    assert read.units_per_metre == 1.0


def test_parts_of_a_scene_are_placed_and_a_mirrored_one_keeps_its_front():
    box, scene = trimesh.creation.box((1, 1, 1)), trimesh.Scene()
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[0, 3] = 7.0
    scene.add_geometry(
        box, node_name="a", transform=trimesh.transformations.translation_matrix([0, 2, 0])
    )
    scene.add_geometry(box, node_name="b", transform=mirror)
    scene.add_geometry(trimesh.PointCloud(path(20)), node_name="c")
    read = read_surface(exported(scene, "glb"), "map.glb")
    placed = scene.to_mesh()
    assert len(placed.faces) == 24
    np.testing.assert_allclose(corners(read.surface), sorted_rows(placed.triangles), atol=1e-6)
    assert read.notes == ("1 parts without triangles were skipped.",)


def ply(faces, order, vertices):
    """A PLY file of polygons, with a number and another list beside each."""
    head = (
        f"ply\nformat {order} 1.0\nelement vertex {len(vertices)}\nproperty double x\n"
        "property double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty uchar red\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nend_header\n"
    ).encode()
    if order == "ascii":
        rows = [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        rows += [f"7 {len(face)} {' '.join(map(str, face))} 2 0.5 1e-3" for face in faces]
        return head + ("\n".join(rows) + "\n").encode()
    sign = "<" if "little" in order else ">"
    body = vertices.astype(f"{sign}f8").tobytes()
    for face in faces:
        body += struct.pack(f"{sign}BB{len(face)}iB2f", 7, len(face), *face, 2, 0.5, 1e-3)
    return head + body


ORDERS = ["ascii", "binary_little_endian", "binary_big_endian"]


@pytest.mark.parametrize("order", ORDERS)
def test_polygons_become_fans(order):
    vertices = path(9)
    data = ply([[0, 1, 2], [3, 4, 5, 6], [8, 7, 6, 5, 4], [2, 1, 7]], order, vertices)
    fans = [(0, 1, 2), (3, 4, 5), (3, 5, 6), (8, 7, 6), (8, 6, 5), (8, 5, 4), (2, 1, 7)]
    read = read_surface(data, "map.ply", STATED)
    np.testing.assert_allclose(
        corners(read.surface), sorted_rows(vertices[np.array(fans)]), atol=1e-4
    )


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("faces", "message"),
    [
        ([[0, 1, 2], [0, 1, 9]], r"Triangle 2 of 2 refers to a vertex that is not among the 9"),
        ([[0, 1, -1]], "refers to a vertex that is not among"),
        ([[0, 1]], "corners"),
    ],
)
def test_wrong_polygons(order, faces, message):
    with pytest.raises(UnreadableCloud, match=f"{message}.*again"):
        read_surface(ply(faces, order, path(9)), "map.ply")


def test_what_is_no_triangle_is_left_out():
    vertices = path(9)
    vertices[3] = np.nan
    vertices[6:8] = vertices[5]
    faces = [[0, 1, 2], [0, 1, 3], [4, 4, 5], [5, 6, 8], [8, 2, 1]]
    read = read_surface(ply(faces, "ascii", vertices), "map.ply", STATED)
    kept = vertices[np.array([faces[0], faces[4]])]
    np.testing.assert_allclose(corners(read.surface), sorted_rows(kept), atol=1e-4)
    assert len(read.surface.points) == 4  # of those, none without a triangle
    assert read.notes == ("3 triangles without area or with missing vertices were skipped.",)
    with pytest.raises(UselessFrame, match="None of the 1 triangles"):
        read_surface(ply([[4, 4, 5]], "ascii", vertices), "map.ply", STATED)


@pytest.mark.parametrize("form", ["obj", "ply"])
def test_a_mesh_without_a_face_is_a_cloud(form):
    data = exported(trimesh.PointCloud(path(50)), "ply")
    if form == "obj":
        data = "".join(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in path(50)).encode()
    read = read_surface(data, f"map.{form}", STATED)
    assert read.surface.triangles is None
    np.testing.assert_allclose(read.surface.points, path(50), atol=MILLIMETRE)


def test_polygons_and_indices_from_the_end_in_obj():
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv .5 2 0\nvn 0 0 1\n"
    for faces in ("f 1//1 2//1 3//1 4//1\n", "f -5 -4 -3 -2\n", "f 1 2 3 4 \\\n\n"):
        read = read_surface(f"mtllib no.mtl\n{text}usemtl x\n{faces}".encode(), "a.obj", STATED)
        assert len(read.surface.triangles) == 2
    read = read_surface(f"{text}f 1 2 3 5 4\nf 1 2 3\n".encode(), "a.obj", STATED)
    assert len(read.surface.triangles) == 4


def test_millimetres_are_recognised():
    box = trimesh.creation.box((6000, 4500, 2500))
    read = read_surface(exported(box, "stl"), "room.stl")
    assert (read.units, read.units_per_metre) == ("estimated", 1000.0)
    assert (
        "Units were estimated from the extent of 6000 x 4500 x 2500: millimetres" in read.notes[1]
    )
    assert np.abs(read.surface.points).max() == pytest.approx(3.0)


# Broken and hostile files.


def files():
    mesh, cloud = steps(), trimesh.PointCloud(path(100))
    pcd = b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 100\nHEIGHT 1\n"
    return {
        "a.pcd": pcd + b"POINTS 100\nDATA binary\n" + path(100).astype("<f4").tobytes(),
        "cloud.ply": exported(cloud, "ply"),
        "mesh.ply": exported(mesh, "ply"),
        "ascii.ply": ply(mesh.faces.tolist(), "ascii", np.asarray(mesh.vertices)),
        "a.las": las_with(34735, keys((1024, 1))),
        "a.npy": encode_npy(path(100)),
        "a.obj": exported(mesh, "obj"),
        "a.stl": exported(mesh, "stl"),
        "ascii.stl": exported(mesh, "stl_ascii"),
        "a.glb": exported(mesh, "glb"),
        "a.gltf": exported(mesh, "gltf"),
    }


@pytest.mark.parametrize("name", [name for name in files() if name != "a.obj"])
def test_cut_files_are_refused_with_a_remedy(name):
    data = files()[name]
    read_surface(data, name)
    for share in (0.3, 0.6, 0.97):
        with pytest.raises(UnreadableCloud, match=rf"{name}: .*(again|Write the map)"):
            read_surface(data[: int(share * len(data))], name)
    with pytest.raises(UnreadableCloud, match="empty"):
        read_surface(b"", name)


@pytest.mark.parametrize("name", list(files()))
def test_noise_in_any_file_is_an_error_of_ours_or_none(name):
    data, rng = files()[name], np.random.default_rng(5)
    for _ in range(60):
        broken = bytearray(data)
        for place in rng.integers(0, min(len(data), 4000), 3).tolist():
            broken[place] = int(rng.integers(0, 256))
        try:
            with np.errstate(all="ignore"):
                read_surface(bytes(broken), name)
        except (UnreadableCloud, UselessFrame):
            continue


def changed_gltf(change):
    tree = json.loads(exported(steps(), "gltf"))
    change(tree)
    return json.dumps(tree).encode()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["buffers"][0].update(uri="model.bin"), "another file, 'model.bin'.*GLB"),
        (lambda t: t["buffers"][0].update(uri="file:///etc/passwd"), "another file.*GLB"),
        (
            lambda t: t.update(extensionsRequired=["KHR_draco_mesh_compression"]),
            "extension 'KHR_draco.*without compression",
        ),
        (lambda t: t["accessors"][0].pop("bufferView"), "without a buffer view"),
        (lambda t: t["accessors"][0].update(count=10**15), "cannot be read"),
    ],
)
def test_gltf_that_needs_more_than_its_bytes(change, message):
    with pytest.raises(UnreadableCloud, match=message):
        read_surface(changed_gltf(change), "a.gltf")


def test_a_part_that_is_placed_too_often_is_refused_unbuilt():
    ball = trimesh.creation.icosphere(subdivisions=5)
    tree = json.loads(exported(ball, "gltf"))
    mesh = next(node["mesh"] for node in tree["nodes"] if "mesh" in node)
    tree["nodes"] = [{"mesh": mesh, "name": str(k)} for k in range(2000)]
    tree["scenes"], tree["scene"] = [{"nodes": list(range(2000))}], 0
    with pytest.raises(UnreadableCloud, match=r"the limit is 15000000\. Simplify"):
        read_surface(json.dumps(tree).encode(), "a.gltf")


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.pcd", b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 4000000000\n"
                  b"HEIGHT 1\nPOINTS 4000000000\nDATA binary\n", "the limit is 60000000. Down"),
        ("a.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
                  b"property float y\nproperty float z\nelement face 3000000000\n"
                  b"property list uchar int vertex_indices\nend_header\n", "Simplify the mesh"),
        ("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50), "again"),
        ("a.glb", b"glTF" + struct.pack("<IIII", 2, 100, 2**31, 0x4E4F534A), "again|as glTF 2"),
        ("a.gltf", b"[" * 100_000, "not JSON"),
    ],
)  # fmt: skip
def test_headers_that_announce_what_is_not_there(name, data, message):
    with pytest.raises(UnreadableCloud, match=message):
        read_surface(data, name)


@pytest.mark.parametrize("far", [3e4, 1e20, 1e300])
def test_a_place_of_more_than_twenty_kilometres_is_refused(far):
    points = path(100)
    points[50, 1] = far
    with pytest.raises(UnreadableCloud, match="isolated distant points"):
        read_surface(encode_npy(points), "a.npy", STATED)


# Thinning while reading.


def test_a_cloud_of_too_many_points_is_thinned_while_it_is_read():
    rng = np.random.default_rng(3)
    points = rng.uniform((-20, -15, 0), (20, 15, 5), (50_000, 3)) + np.array([5e5, 4e6, 0])
    blocks = np.array_split(points, 13)
    actual, origin, voxel = gather(iter(blocks), len(points), lambda _: 1.0, most=4000)
    assert voxel is not None
    assert 1000 < len(actual) <= 4000
    # one point to a voxel, each a point of the file, and no voxel of the file is lost but few
    cells = np.floor(actual / voxel).astype(int)
    assert len(np.unique(cells, axis=0)) == len(actual)
    back = actual.astype(np.float64) + origin
    nearest = [np.abs(points - one).max(axis=1).min() for one in back[::50]]
    assert max(nearest) < 1e-5
    whole = np.unique(np.floor((points - origin) / voxel).astype(int), axis=0)
    assert len(actual) > 0.9 * len(whole)
    # the same file gives the same points
    other, _, _ = gather(iter(blocks), len(points), lambda _: 1.0, most=4000)
    np.testing.assert_array_equal(actual, other)
