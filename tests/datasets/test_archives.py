"""Tests that archives give the same frames as folders, and that faults affect single members."""

import bz2
import gzip
import io
import lzma
import os
import random
import shutil
import struct
import subprocess
import sys
import tarfile
import zipfile
import zlib
from contextlib import contextmanager

import numpy as np
import pytest

from sceneprint.errors import SceneprintError, UnreadableArchive
from sceneprint.formats import archive as archives
from sceneprint.formats import archive as inflating
from sceneprint.formats.archive import Inflater, is_archive, open_archive
from sceneprint.formats.dataset import (
    Camera,
    find_sequences,
    write_depth_png,
    write_intrinsics,
    write_pose,
)
from tests.datasets.shared import CAMERA, DEPTH, pose_at, seven_scenes

PACKERS = {
    "gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress,
}  # fmt: skip


FULL = """
import subprocess, sys
from pathlib import Path
from sceneprint.formats.archive import open_archive

archive, folder = map(Path, sys.argv[1:])
subprocess.run(["mount", "-t", "tmpfs", "-o", "nr_inodes=12", "none", folder], check=True)
try:
    with archive.open("rb") as file, open_archive(file, folder) as opened:
        print(opened.refused)
except OSError as error:
    print(error.strerror)
print(list(folder.iterdir()))
"""


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    """A scene of 7-Scenes with two sequences and colour."""
    scene = tmp_path_factory.mktemp("scenes") / "kitchen"
    for number in (1, 2):
        seven_scenes(scene / f"seq-{number:02d}", frames=3, farther=10 * number)
    (scene / "TrainSplit.txt").write_text("sequence1\n")
    write_intrinsics(scene, CAMERA)
    return scene


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder of TUM, whose name has `rgb` in it, with colour and a trajectory."""
    folder = tmp_path_factory.mktemp("tum") / "rgbd_dataset_freiburg1_desk"
    (folder / "depth").mkdir(parents=True)
    (folder / "rgb").mkdir()
    (folder / "rgb" / "1.png").write_bytes(b"colour")
    lines = []
    for i in range(2):
        write_depth_png(folder / "depth" / f"{1305031453 + i}.png", DEPTH + np.float32(i), 5000.0)
        lines.append(f"{1305031453 + i} depth/{1305031453 + i}.png")
    (folder / "depth.txt").write_text("# list\n" + "\n".join(lines) + "\n")
    rows = [f"{1305031453 + i / 20:.2f} {i / 20} 0 0 0 0 0 1" for i in range(21)]
    (folder / "groundtruth.txt").write_text("\n".join(rows) + "\n")
    write_intrinsics(folder, Camera(CAMERA.intrinsics, 5000.0))
    return folder


def zipped(folder, **options):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", options.get("method", zipfile.ZIP_DEFLATED)) as packed:
        for path in sorted(folder.rglob("*")):
            packed.write(path, path.relative_to(folder.parent))
    return buffer.getvalue()


def tarred(folder, form=tarfile.GNU_FORMAT):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=form) as packed:
        packed.add(folder, folder.name)
    return buffer.getvalue()


def tar_of(*members):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.GNU_FORMAT) as packed:
        for member in members:
            if isinstance(member, tarfile.TarInfo):
                packed.addfile(member, io.BytesIO(bytes(member.size)))
                continue
            info = tarfile.TarInfo(member[0])
            info.size = len(member[1])
            packed.addfile(info, io.BytesIO(member[1]))
    return buffer.getvalue()


def inflated(data, most=1 << 30, step=1 << 16):
    inflater = Inflater(most)
    parts = [p for i in range(0, len(data), step) for p in inflater.pieces(data[i : i + step])]
    return b"".join([*parts, *inflater.end()])


@contextmanager
def looked_into(data, folder, name="import"):
    with open_archive(io.BytesIO(inflated(data)), folder, name) as archive:
        yield archive


def said(sequence, frame, data):
    pose = None if frame.pose is None else frame.pose.tolist()
    of_all = (sequence.name, sequence.parent_frame, sequence.layout, sequence.split)
    return (*of_all, frame.name, frame.camera, frame.timestamp, pose, data)


def contents(archive):
    return [said(s, f, archive.data_of(f)) for s in archive.sequences for f in s.frames]


def oracle(folder):
    return [said(s, f, f.path.read_bytes()) for s in find_sequences(folder) for f in s.frames]


@pytest.mark.parametrize("kind", ["zip", "stored", "tar", "pax", "ustar", "gz", "bz2", "xz"])
@pytest.mark.parametrize("which", ["kitchen", "desk"])
def test_it_is_read_as_the_folder_is(kind, which, kitchen, desk, tmp_path):
    folder = {"kitchen": kitchen, "desk": desk}[which]
    forms = {"pax": tarfile.PAX_FORMAT, "ustar": tarfile.USTAR_FORMAT}
    if kind in ("zip", "stored"):
        data = zipped(folder, method=zipfile.ZIP_STORED if kind == "stored" else 8)
    else:
        data = PACKERS.get(kind, bytes)(tarred(folder, forms.get(kind, tarfile.GNU_FORMAT)))
    assert is_archive(data[:512])
    with looked_into(data, tmp_path) as archive:
        assert contents(archive) == oracle(folder)
        assert archive.refused == []
        assert archive.ignored == (6 if which == "kitchen" else 1)
        first = archive.sequences[0].frames[0]
        assert archive.name_of(first).startswith(f"{folder.name}/")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("image", "pose"),
    [
        ("scene/frame_depth_1.png", "scene/frame_pose_1.txt"),
        ("scene/depth/1.png", "scene/pose/1.txt"),
        ("scene/1.png", "scene/1.pose.txt"),
    ],
)
def test_an_archive_has_the_poses_that_its_folder_has(image, pose, tmp_path):
    folder = tmp_path / "packed"
    for one in (image, pose):
        (folder / one).parent.mkdir(parents=True, exist_ok=True)
    write_depth_png(folder / image, DEPTH, 1000.0)
    write_pose(folder / pose, pose_at(3.0))
    write_intrinsics(folder / "scene", CAMERA)
    (of_folder,) = find_sequences(folder / "scene")
    assert of_folder.frames[0].pose is not None
    with looked_into(zipped(folder / "scene"), tmp_path) as archive:
        (of_archive,) = archive.sequences
        pose = of_archive.frames[0].pose
    assert pose is not None
    np.testing.assert_array_equal(pose, of_folder.frames[0].pose)


def test_what_has_no_folder_is_named_by_the_caller(kitchen, tmp_path):
    members = [(p.name, p.read_bytes()) for p in sorted((kitchen / "seq-01").glob("*.depth.png"))]
    camera = ("intrinsics.json", (kitchen / "intrinsics.json").read_bytes())
    with looked_into(tar_of(camera, *members), tmp_path, "hall") as archive:
        assert [(s.name, s.parent_frame) for s in archive.sequences] == [("hall", "hall")]
    nested = [(f"seq-01/{name}", data) for name, data in members]
    with looked_into(tar_of(("seq-01/intrinsics.json", camera[1]), *nested), tmp_path, "hall") as a:
        assert [(s.name, s.parent_frame) for s in a.sequences] == [("seq-01", "hall")]


def test_a_camera_is_not_looked_for_outside_the_archive(kitchen, tmp_path):
    write_intrinsics(tmp_path, CAMERA)  # beside the private folder
    image = (kitchen / "seq-01" / "frame-000000.depth.png").read_bytes()
    with looked_into(tar_of(("a.png", image)), tmp_path) as archive:
        assert archive.sequences == ()
        [(name, reason)] = archive.refused
    assert name == "import"
    assert "There is no intrinsics.json" in reason
    assert str(tmp_path) not in reason


def test_names_that_lead_elsewhere_are_refused_and_the_rest_is_taken(kitchen, tmp_path):
    image = (kitchen / "seq-01" / "frame-000000.depth.png").read_bytes()
    camera = (kitchen / "intrinsics.json").read_bytes()
    link, device = tarfile.TarInfo("s/link.png"), tarfile.TarInfo("s/tty.png")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    device.type = tarfile.CHRTYPE
    odd = ["/etc/a.png", "../../b.png", "s/../../c.png", "C:\\d.png", "s/e\n.png", "s/\udcff.png"]
    deep, long = "x/" * 20 + "f.png", "s/" + "y" * 300 + ".png"
    data = tar_of(
        ("s/intrinsics.json", camera), ("./s/good.png", image), link, device,
        *((name, image) for name in [*odd, deep, long]), ("s/good.png", b"another"),
        ("s/good.png/below.png", image),
    )  # fmt: skip
    with looked_into(data, tmp_path) as archive:
        assert [f.name for s in archive.sequences for f in s.frames] == [
            "s/good", "s/link", "s/tty",
        ]  # fmt: skip
        good, linked, _ = archive.sequences[0].frames
        assert archive.data_of(good) == image
        with pytest.raises(UnreadableArchive, match=r"s/link.png: it is a link"):
            archive.data_of(linked)
        reasons = dict(archive.refused)
        assert len(archive.refused) == len(odd) + 4
    assert "absolute" in reasons["/etc/a.png"]
    assert "absolute" in reasons["C:\\d.png"]
    assert "points out" in reasons["../../b.png"]
    assert "points out" in reasons["s/../../c.png"]
    assert "not printable" in reasons["s/e\\n.png"]
    assert "not printable" in reasons["s/\\udcff.png"]
    assert "15 folders" in reasons[deep]
    assert "an earlier member has the same name" in reasons["s/good.png"]
    assert "its name conflicts" in reasons["s/good.png/below.png"]
    assert {p.name for p in tmp_path.iterdir()} == set()


def test_a_full_disk_is_no_fault_of_the_members(kitchen, tmp_path):
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode != 0:
        pytest.skip("this machine lets nobody mount anything")
    (tmp_path / "kitchen.zip").write_bytes(zipped(kitchen))
    (tmp_path / "full").mkdir()
    said = subprocess.run(
        ["unshare", "-rm", sys.executable, "-c", FULL, str(tmp_path / "kitchen.zip"),
         str(tmp_path / "full")],
        capture_output=True, text=True, check=True,
    ).stdout.splitlines()  # fmt: skip
    assert said == ["No space left on device", "[]"]


def test_a_damaged_member_costs_itself_alone(kitchen, tmp_path):
    data = bytearray(zipped(kitchen, method=zipfile.ZIP_STORED))
    with zipfile.ZipFile(io.BytesIO(data)) as packed:
        places = {i.filename: i.header_offset for i in packed.infolist()}
    for name in ("seq-01/frame-000001.depth.png", "seq-02/frame-000002.pose.txt"):
        data[places[f"kitchen/{name}"] + 30 + len(f"kitchen/{name}") + 20] ^= 1
    with looked_into(bytes(data), tmp_path) as archive:
        frames = {f.name: f for s in archive.sequences for f in s.frames}
        assert len(frames) == 6
        with pytest.raises(UnreadableArchive, match=r"000001.depth.png: it is damaged \(Bad CRC"):
            archive.data_of(frames["seq-01/frame-000001"])
        assert [name for name, _ in archive.refused] == ["kitchen/seq-02/frame-000002.pose.txt"]
        with pytest.raises(SceneprintError, match="pose") as caught:
            _ = frames["seq-02/frame-000002"].pose
        message = archive.message_of(caught.value)
        assert message.startswith("import/kitchen/seq-02/frame-000002.pose.txt")
        assert frames["seq-02/frame-000001"].pose is not None


def test_a_sequence_without_a_camera_costs_itself_alone(kitchen, tmp_path):
    scene = tmp_path / "two"
    shutil.copytree(kitchen / "seq-01", scene / "a")
    shutil.copytree(kitchen / "seq-02", scene / "b")
    write_intrinsics(scene / "b", CAMERA)
    (tmp_path / "work").mkdir()
    with looked_into(zipped(scene), tmp_path / "work") as archive:
        assert [s.name for s in archive.sequences] == ["b"]
        assert [name for name, _ in archive.refused] == ["a"]


def test_a_tar_that_ends_early_gives_what_it_has(kitchen, tmp_path):
    plain = tarred(kitchen)
    with tarfile.open(fileobj=io.BytesIO(plain)) as packed:
        last = max(i.offset_data for i in packed.getmembers() if i.name.endswith("depth.png"))
    with looked_into(plain[: last + 20], tmp_path) as archive:
        assert sum(len(s.frames) for s in archive.sequences) >= 5
        cut = [f for s in archive.sequences for f in s.frames if f.path.name[:12] == "frame-000002"]
        with pytest.raises(UnreadableArchive, match="the archive ends within this member"):
            _ = [archive.data_of(one) for one in cut]
    torn = bytearray(plain)
    torn[last - 512 + 150] ^= 1  # the sum of its header
    with looked_into(bytes(torn), tmp_path) as archive:
        assert "the rest cannot be read" in archive.refused[-1][1]


def test_encrypted_and_strangely_packed_members_are_told(kitchen, tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as packed:
        packed.write(kitchen / "intrinsics.json", "s/intrinsics.json")
        image = (kitchen / "seq-01" / "frame-000000.depth.png").read_bytes()
        packed.writestr("s/1.png", image)
        packed.writestr("s/2.png", image, zipfile.ZIP_LZMA)
    data = bytearray(buffer.getvalue())
    entry = data.rindex(b"PK\x01\x02", 0, data.index(b"s/1.png", data.index(b"PK\x01\x02")))
    data[entry + 8] |= 1
    with looked_into(bytes(data), tmp_path) as archive:
        locked, strange = archive.sequences[0].frames
        with pytest.raises(UnreadableArchive, match="encrypted"):
            archive.data_of(locked)
        with pytest.raises(UnreadableArchive, match="method 14"):
            archive.data_of(strange)


def test_bombs_are_refused_while_they_burst(tmp_path, monkeypatch):
    for module in (inflating, archives):  # the same with less to write
        monkeypatch.setattr(module, "FREE", 1 << 20)
    info = tarfile.TarInfo("s/a.npy")
    info.size = 1 << 28
    for pack in PACKERS.values():
        bomb = pack(info.tobuf() + bytes(3 << 20))
        with pytest.raises(UnreadableArchive, match="50 times the size"):
            inflated(bomb)
        with pytest.raises(UnreadableArchive, match="exceeds 4096 bytes"):
            inflated(bomb, most=4096)
    twice = gzip.compress(gzip.compress(tar_of(("a.png", b"x"))))
    with pytest.raises(UnreadableArchive, match="is not a tar"):
        inflated(twice + bytes(512))
    # a zip whose 900 entries are one member, of which each declares 1 MB
    body = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = body.compress(bytes(1 << 20)) + body.flush()
    local = struct.pack(
        "<4sHHHHHIIIHH", b"PK\x03\x04", 20, 0, 8, 0, 0, 0, len(packed), 1 << 20, 0, 0
    )
    entries = b"".join(
        struct.pack("<4sBBHHHHHIIIHHHHHII", b"PK\x01\x02", 20, 3, 20, 0, 8, 0, 0, 0, len(packed),
                    1 << 20, len(f"{i}.npy"), 0, 0, 0, 0, 0, 0) + f"{i}.npy".encode()
        for i in range(900)
    )  # fmt: skip
    start = len(local) + len(packed)
    end = struct.pack("<4sHHHHIIH", b"PK\x05\x06", 0, 0, 900, 900, len(entries), start, 0)
    with (
        pytest.raises(UnreadableArchive, match="times the size"),
        looked_into(local + packed + entries + end, tmp_path),
    ):
        pass


def extended(kind, content):
    """A header of a tar that tells more of what follows it."""
    info = tarfile.TarInfo("more")
    info.type, info.size = kind, len(content)
    return info.tobuf(tarfile.GNU_FORMAT) + content + bytes(-len(content) % 512)


def sparse(blocks):
    """A member with holes, whose list of them goes on for some blocks."""
    info = tarfile.TarInfo("s/holes.npy")
    info.type = b"S"
    head = bytearray(info.tobuf(tarfile.GNU_FORMAT))
    head[482] = 1
    head[148:156] = b" " * 8
    head[148:155] = b"%06o\0" % sum(head)
    return bytes(head) + (bytes([0] * 504) + b"\1" + bytes(7)) * blocks


@pytest.mark.parametrize(
    "head",
    [
        extended(b"x", b"12 path=abcd\n" * 100_000),
        extended(b"g", b"12 path=abcd\n" * 100_000),
        extended(b"L", b"n" * 1_000_000),
        extended(b"L", b"name") * 2000,
        extended(b"x", b"11 size=-7\n") + tar_of(("s/a.png", b"x"))[:1024],
        sparse(2000),
    ],
    ids=["pax", "global", "long name", "chain", "backwards", "holes"],
)
def test_headers_of_a_tar_are_bounded(head, tmp_path):
    sound = tar_of(("s/a.png", b"x"))[:1024]
    with looked_into(sound + head + tar_of(("s/b.png", b"y")), tmp_path) as archive:
        assert archive.refused[0] == ("s/a.png", f"s/a.png: {inflating._DAMAGED}.")


def test_a_zip_of_too_many_members_is_refused_before_they_are_read(kitchen, tmp_path, monkeypatch):
    monkeypatch.setattr(inflating, "MOST_MEMBERS", 14)  # of 16
    with (
        pytest.raises(UnreadableArchive, match="more than 14"),
        looked_into(zipped(kitchen), tmp_path),
    ):
        pass


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "The archive is empty"),
        (b"\x89PNG\r\n\x1a\n" + bytes(600), "not a supported archive"),
        (bytes(1024), "not a supported archive"),
        (b"PK\x03\x04" + bytes(600), "The zip is damaged or truncated"),
        (gzip.compress(b""), "is not a tar"),
        (gzip.compress(tar_of(("a.png", b"x")))[:-9], "truncated"),
        (gzip.compress(tar_of(("a.png", b"x"))) + b"more", "damaged"),
        (b"\x1f\x8b" + bytes(600), "damaged"),
        (tar_of(("notes.txt", b"nothing")), "The archive has no depth images"),
        (tar_of(("inner.zip", b"PK\x03\x04")), "archives within it"),
    ],
    ids=range(10),  # gzip writes the time of the day: not every process would call them alike
)
def test_what_is_no_archive_of_frames_says_so(data, reason, tmp_path):
    with pytest.raises(UnreadableArchive, match=reason), looked_into(data, tmp_path):
        pass


def test_no_mutation_surprises(kitchen, desk, tmp_path):
    seeds = [zipped(kitchen), zipped(desk), tarred(kitchen), tarred(desk, tarfile.PAX_FORMAT)]
    seeds += [gzip.compress(seeds[2]), lzma.compress(seeds[3])]
    draw, refused = random.Random(6), 0
    for i in range(120):
        data = bytearray(seeds[i % len(seeds)])
        for _ in range(draw.choice((1, 3, 30))):
            place = draw.randrange(len(data))
            if draw.random() < 0.1:
                del data[place : place + draw.randrange(len(data) // 4)]
            else:
                data[place] = draw.choice((0, 1, 0x7F, 0xFF, draw.randrange(256)))
        try:
            with looked_into(bytes(data), tmp_path) as archive:
                refused += bool(archive.refused)
                for reference in (f for s in archive.sequences for f in s.frames):
                    try:
                        archive.data_of(reference)
                        assert reference.pose is None or reference.pose.shape == (4, 4)
                    except SceneprintError:
                        refused += 1
        except SceneprintError:
            refused += 1
    assert refused > 50
    assert os.listdir(tmp_path) == []  # noqa: PTH208
