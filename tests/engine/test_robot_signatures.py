"""Signatures that robots send with their frames: taken, sampled, found wrong, refused."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from zlib import crc32

import numpy as np
import pytest
from sqlalchemy import select, update

from sceneprint.engine import Engine
from sceneprint.engine.admin.operations import list_keys
from sceneprint.engine.ingest.frame_decoder import content_id, read_upload
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.jobs import robot_signatures, signature_job
from sceneprint.engine.jobs.lifecycle import cancel
from sceneprint.engine.jobs.robot_signatures import (
    EVERY_S,
    FIRST,
    RobotSignatures,
    SentSignature,
    difference,
)
from sceneprint.engine.upkeep.garbage_collection import collect_doomed_blobs
from sceneprint.errors import FrameError, InvalidRequest, QuotaExceeded
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.formats.signature_package import SignaturePackage, read_package, write_package
from sceneprint.maintenance.fsck import check
from sceneprint.pipeline import open_signer
from sceneprint.store.frames import refers_to
from sceneprint.store.keys import IdempotentRequest, find_named_key
from sceneprint.store.maps import counted_usage, find_map, use_of
from sceneprint.store.sender_rows import add_verified, distrust_sender, find_sender
from sceneprint.store.tables import frames, job_files, maps, signatures
from sceneprint_client.api import Added, FrameState, JobState, NewMap, Query

Make = Callable[..., Engine]
WorkOff = Callable[[Engine], list[JobState | None]]
#: So small that chance never draws a frame of a test.
NONE_SAMPLED = 1e-9


@pytest.fixture
def trusting(make_engine: Make) -> Engine:
    """An engine that trusts robots, with the empty map `hall` and the key `cart`, which has sent
    enough that was right.
    """
    engine = make_engine(trust_signatures=True, signed_sample=NONE_SAMPLED)
    engine.create_map(NewMap(name="hall", model="depth"))
    known(engine, key_of(engine))
    return engine


def key_of(engine: Engine, name: str = "cart") -> str:
    """The id of a new key."""
    secret = engine.create_key(name, {"hall": "write"}).secret
    found = engine.find_key(secret)
    assert found is not None
    return found.id


def known(engine: Engine, key_id: str, times: int = FIRST) -> None:
    with engine.store.database.write() as connection:
        for _ in range(times):
            add_verified(connection, key_id)


def key_id(engine: Engine, name: str = "cart") -> str:
    with engine.store.database.read() as connection:
        return find_named_key(connection, name).id


def package_of(engine: Engine, upload: Any) -> SignaturePackage:
    return read_package(engine.sign_frame("hall", upload.data, upload.meta))


def add(engine: Engine, upload: Any, package: SignaturePackage | bytes, **more: Any) -> Added:
    data = package if isinstance(package, bytes) else write_package(package)
    given = {"signed": data, "sender": key_id(engine)} | more
    outcome, _ = engine.uploads.add("hall", Upload(upload.data, upload.meta, **given))
    return outcome.taken


def moved(package: SignaturePackage) -> SignaturePackage:
    """A package that is as sound as the one that is given, and another: another signature."""
    return replace(package, vector=bytes(255 - one for one in package.vector))


def job(engine: Engine, added: Added) -> Any:
    return engine.get_job(added.job_id)


def stored(engine: Engine, added: Added) -> Any:
    asked = select(signatures).join(frames, frames.c.number == signatures.c.frame_number)
    with engine.store.database.read() as connection:
        return connection.execute(asked.where(frames.c.id == added.frame_id)).one()


def packages(engine: Engine) -> list[Any]:
    with engine.store.database.read() as connection:
        return list(connection.execute(select(job_files.c.blob, job_files.c.bytes)).all())


def usage(engine: Engine) -> tuple[int, int]:
    """Bytes that the map is counted to hold, and that it holds."""
    with engine.store.database.read() as connection:
        row = find_map(connection, "hall")
        return use_of(connection, row.number).bytes, counted_usage(connection, row.number).bytes


def tidy(engine: Engine) -> int:
    engine.robot_signatures._tidied -= EVERY_S  # it is time
    return engine.robot_signatures.tidy()


def signed_by(engine: Engine, added: Added) -> str | None:
    return engine.get_frame("hall", added.frame_id).signed_by


# taken


def test_what_a_robot_made_is_taken_without_signing(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    package = moved(package_of(trusting, uploads[0]))  # a worker would make another one
    added = add(trusting, uploads[0], package)
    assert added.signed == "kept"
    [(blob, size)] = packages(trusting)
    assert size == len(write_package(package))
    assert usage(trusting) == (len(uploads[0].data) + size,) * 2

    assert work_off(trusting) == [JobState.SUCCEEDED]
    row = stored(trusting, added)
    assert (row.vector, row.sender) == (package.vector, key_id(trusting))
    assert trusting.store.blobs.get(row.geometry) == package.artifact
    assert (tuple(row.n_patches), tuple(row.n_pairs)) == (package.n_patches, package.n_pairs)
    assert job(trusting, added).result == {"signed_by": "robot", "sent": "taken"}
    assert signed_by(trusting, added) == "robot"
    tidy(trusting)
    assert packages(trusting) == []
    assert not trusting.store.blobs.holds(blob)
    assert usage(trusting) == (len(uploads[0].data),) * 2


def test_it_is_found_as_if_a_worker_had_signed_it(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    for each in uploads[:3]:
        add(trusting, each, package_of(trusting, each))
    work_off(trusting)
    answer = trusting.queries.upload(["hall"], uploads[1].data, uploads[1].meta, Query(k=1))
    assert answer.status == "found"
    added = trusting.add_frame("hall", uploads[1].data, uploads[1].meta)[0]
    assert answer.matches[0].frame_id == added.frame_id
    assert added.state == FrameState.INDEXED


def test_a_frame_without_a_package_is_signed_by_the_service(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    added = trusting.add_frame("hall", uploads[0].data, uploads[0].meta)[0]
    assert added.signed is None
    assert signed_by(trusting, added) is None  # not yet
    work_off(trusting)
    assert signed_by(trusting, added) == "service"
    assert job(trusting, added).result is None


def test_a_frame_under_an_id_of_the_robots_own(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    package = package_of(trusting, uploads[0])
    added = add(trusting, uploads[0], package, frame_id="scan-7")
    assert packages(trusting) != []
    assert usage(trusting)[0] == usage(trusting)[1] > len(uploads[0].data)
    work_off(trusting)
    assert signed_by(trusting, added) == "robot"
    tidy(trusting)
    assert usage(trusting) == (len(uploads[0].data),) * 2


def test_a_redundant_frame_leaves_nothing(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    add(trusting, uploads[0], package_of(trusting, uploads[0]))
    work_off(trusting)
    tidy(trusting)
    added = add(trusting, uploads[1], package_of(trusting, uploads[1]), if_novel=1.0)
    [(blob, _)] = packages(trusting)
    work_off(trusting)
    assert trusting.get_frame("hall", added.frame_id).state == FrameState.REDUNDANT
    tidy(trusting)
    assert packages(trusting) == []
    assert not trusting.store.blobs.holds(blob)
    assert usage(trusting) == (len(uploads[0].data),) * 2


# not kept


def test_packages_are_ignored_unless_robots_are_trusted(
    empty: Engine, uploads: Any, work_off: WorkOff
) -> None:
    key_of(empty)
    added = add(empty, uploads[0], b"whatever it is")
    assert added.signed == "off"
    assert packages(empty) == []
    work_off(empty)
    assert signed_by(empty, added) == "service"


def test_without_a_key_nobody_can_be_distrusted(trusting: Engine, uploads: Any) -> None:
    package = package_of(trusting, uploads[0])
    assert add(trusting, uploads[0], package, sender=None).signed == "keyless"
    assert packages(trusting) == []


def test_other_signing_code(trusting: Engine, uploads: Any, work_off: WorkOff) -> None:
    package = replace(package_of(trusting, uploads[0]), signing_version=99)
    assert add(trusting, uploads[0], package).signed == "other_version"
    assert packages(trusting) == []


def test_a_frame_that_is_there_already(trusting: Engine, uploads: Any, work_off: WorkOff) -> None:
    package = package_of(trusting, uploads[0])
    first = add(trusting, uploads[0], package)
    again = add(trusting, uploads[0], package)
    assert (again.frame_id, again.signed) == (first.frame_id, "known")
    assert len(packages(trusting)) == 1
    work_off(trusting)
    assert add(trusting, uploads[0], moved(package)).signed == "known"
    tidy(trusting)
    assert packages(trusting) == []


def test_robots_may_come_to_be_trusted_no_more(
    trusting: Engine, uploads: Any, work_off: WorkOff, make_engine: Make
) -> None:
    added = add(trusting, uploads[0], moved(package_of(trusting, uploads[0])))
    work_off(make_engine())
    assert signed_by(trusting, added) == "service"
    assert job(trusting, added).result["signed_by"] == "service"
    tidy(trusting)
    assert packages(trusting) == []


# refused


def test_what_is_of_another_frame_is_refused(trusting: Engine, uploads: Any) -> None:
    package = package_of(trusting, uploads[1])
    with pytest.raises(InvalidRequest, match="samples, camera or viewpoint differ") as refused:
        add(trusting, uploads[0], package)
    assert refused.value.fields == (("signed", "of another frame"),)
    assert trusting.list_frames("hall").items == []
    assert usage(trusting) == (0, 0)


def test_what_is_of_another_model_is_refused(trusting: Engine, uploads: Any) -> None:
    package = replace(package_of(trusting, uploads[0]), model_id="ab" * 32)
    with pytest.raises(InvalidRequest, match="Sign the frame with the map's model"):
        add(trusting, uploads[0], package)
    assert trusting.list_frames("hall").items == []


@pytest.mark.parametrize("spoil", ["cut", "changed", "nothing", "other"])
def test_what_is_no_package_is_refused(trusting: Engine, uploads: Any, spoil: str) -> None:
    sound = write_package(package_of(trusting, uploads[0]))
    spoilt = {
        "cut": sound[:-1], "changed": sound[:-1] + bytes([sound[-1] ^ 1]), "nothing": b"",
        "other": b"SPSIG\x02\x00" + sound[7:],
    }[spoil]  # fmt: skip
    with pytest.raises(InvalidRequest, match=r"The part `signed` (is|has)"):
        add(trusting, uploads[0], spoilt)
    assert trusting.list_frames("hall").items == []


def test_a_quota_holds_for_packages_too(trusting: Engine, uploads: Any) -> None:
    package = package_of(trusting, uploads[0])
    with trusting.store.database.write() as connection:
        connection.execute(update(maps).values(quota_bytes=len(uploads[0].data) + 1000))
    with pytest.raises(QuotaExceeded):
        add(trusting, uploads[0], package)
    blob = hashlib.sha256(write_package(package)).hexdigest()
    assert not trusting.store.blobs.holds(blob)
    assert usage(trusting) == (0, 0)
    added = trusting.add_frame("hall", uploads[0].data, uploads[0].meta)[0]
    assert added.state == FrameState.RECEIVED


# sound as a package, and of no use


def hostile(package: SignaturePackage, how: str) -> SignaturePackage:
    geometry = read_geometry(package.artifact)
    camera = geometry.surface.camera
    if how == "no artifact":
        return replace(package, artifact=b"\x80\x04cposix\nsystem\n" * 100)
    if how == "damaged artifact":
        return replace(package, artifact=package.artifact[:-1] + b"\x00")
    if how == "written otherwise":  # a pixel that shows nothing, with a normal
        body = bytearray(package.artifact[11:])
        pixels = np.frombuffer(body, "<u2", offset=80)[: 3 * 160 * 120].reshape(-1, 3)
        empty = int(np.flatnonzero(pixels[:, 0] == 0)[0])
        body[80 + 6 * empty + 2] = 7
        head = package.artifact[:7] + struct.pack("<I", crc32(body))
        return replace(package, artifact=head + bytes(body))
    if how == "short signature":
        return replace(package, vector=package.vector[:-1])
    if how == "levels":
        return replace(package, n_patches=(3, 3), n_pairs=(6, 6))
    if how == "pairs":
        return replace(package, n_pairs=(1 << 60,))
    if how == "no pairs":
        return replace(package, n_pairs=(0,))
    if how == "descriptors":
        short = replace(geometry, descriptors=geometry.descriptors[:, :-1])
        return replace(package, artifact=write_geometry(short))
    if how == "another model's artifact":
        return replace(package, artifact=write_geometry(replace(geometry, model_id="cd" * 32)))
    assert how == "another camera"
    turned = replace(geometry.surface, camera=replace(camera, fx=camera.fx * 2))  # type: ignore
    return replace(package, artifact=write_geometry(replace(geometry, surface=turned)))


@pytest.mark.parametrize(
    "how",
    [
        "no artifact", "damaged artifact", "written otherwise", "short signature", "levels",
        "pairs", "no pairs", "descriptors", "another model's artifact", "another camera",
    ],
)  # fmt: skip
def test_what_is_of_no_use_is_signed_by_the_worker(
    trusting: Engine, uploads: Any, work_off: WorkOff, how: str
) -> None:
    sound = package_of(trusting, uploads[0])
    added = add(trusting, uploads[0], hostile(sound, how))
    assert added.signed == "kept"
    assert work_off(trusting) == [JobState.SUCCEEDED]
    row = stored(trusting, added)
    assert (row.vector, row.sender) == (sound.vector, None)
    result = job(trusting, added).result
    assert result["signed_by"] == "service"
    assert result["sent"].startswith("it is not usable: ")
    if how == "written otherwise":
        assert result["sent"].endswith(how)
    tidy(trusting)
    assert packages(trusting) == []
    with trusting.store.database.read() as connection:  # nothing bad was taken
        assert find_sender(connection, key_id(trusting)).distrusted_at is None


def test_a_worker_with_other_signing_code_signs_itself(
    trusting: Engine, uploads: Any, work_off: WorkOff, monkeypatch: pytest.MonkeyPatch
) -> None:
    added = add(trusting, uploads[0], package_of(trusting, uploads[0]))
    monkeypatch.setattr(robot_signatures, "SIGNING_VERSION", 2)  # upgraded meanwhile
    assert work_off(trusting) == [JobState.SUCCEEDED]
    assert job(trusting, added).result["sent"].endswith("other signing code made it")
    assert signed_by(trusting, added) == "service"


def test_a_package_that_was_lost_costs_nothing(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    added = add(trusting, uploads[0], package_of(trusting, uploads[0]))
    [(blob, _)] = packages(trusting)
    trusting.store.blobs.path(blob).unlink()
    assert work_off(trusting) == [JobState.SUCCEEDED]
    assert signed_by(trusting, added) == "service"
    tidy(trusting)
    assert packages(trusting) == []


# sampled


def sample_all(engine: Engine) -> None:
    engine.robot_signatures._sample = 1.0


def test_a_sampled_frame_that_agrees(trusting: Engine, uploads: Any, work_off: WorkOff) -> None:
    sample_all(trusting)
    added = add(trusting, uploads[0], package_of(trusting, uploads[0]))
    work_off(trusting)
    assert job(trusting, added).result == {"signed_by": "service", "sent": "verified"}
    assert signed_by(trusting, added) == "service"
    assert stored(trusting, added).sender is None
    with trusting.store.database.read() as connection:
        assert find_sender(connection, key_id(trusting)).verified == FIRST + 1


def test_the_first_frames_of_a_key_are_all_sampled(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    new = key_of(trusting, "new")
    known(trusting, new, FIRST - 1)
    outcomes = []
    for each in uploads[:2]:
        added = add(trusting, each, package_of(trusting, each), sender=new)
        work_off(trusting)
        outcomes.append(job(trusting, added).result["sent"])
    assert outcomes == ["verified", "taken"]


def test_the_share_that_is_sampled_is_drawn_by_the_job(trusting: Engine) -> None:
    drawn = [trusting.store.seals.lot(f"job {i}") < 0.25 for i in range(4000)]
    assert 0.22 < np.mean(drawn) < 0.28
    assert drawn == [trusting.store.seals.lot(f"job {i}") < 0.25 for i in range(4000)]


@pytest.fixture
def caught(trusting: Engine, uploads: Any, work_off: WorkOff) -> dict[str, Added]:
    """Two frames that were taken, of which one is wrong, and then one that is sampled and wrong;
    and one of another key.
    """
    other = key_of(trusting, "other")
    known(trusting, other)
    found = {
        "right": add(trusting, uploads[0], package_of(trusting, uploads[0])),
        "wrong": add(trusting, uploads[1], moved(package_of(trusting, uploads[1]))),
        "other": add(trusting, uploads[2], package_of(trusting, uploads[2]), sender=other),
    }
    work_off(trusting)
    assert {signed_by(trusting, one) for one in found.values()} == {"robot"}
    sample_all(trusting)
    found["sampled"] = add(trusting, uploads[3], moved(package_of(trusting, uploads[3])))
    work_off(trusting)
    return found


def test_a_wrong_signature_is_found_and_its_key_trusted_no_more(
    trusting: Engine, uploads: Any, work_off: WorkOff, caught: dict[str, Added],
    told: Callable[[Engine], list[str]],
) -> None:  # fmt: skip
    own = package_of(trusting, uploads[3])
    assert stored(trusting, caught["sampled"]).vector == own.vector
    result = job(trusting, caught["sampled"]).result
    assert result == {"signed_by": "service", "sent": "wrong: the key is trusted no more"}
    assert told(trusting).count("key.distrusted") == 1
    with trusting.store.database.read() as connection:
        sender = find_sender(connection, key_id(trusting))
    assert sender.frame_id == caught["sampled"].frame_id

    keys = {key.name: key.signatures_distrusted_at for key in list_keys(trusting.store).items}
    assert keys["cart"] is not None
    assert keys["other"] is None


def test_what_a_wrong_key_sent_before_is_signed_again(
    trusting: Engine, uploads: Any, work_off: WorkOff, caught: dict[str, Added],
    told: Callable[[Engine], list[str]],
) -> None:  # fmt: skip
    assert tidy(trusting) == 2
    assert tidy(trusting) == 0  # once
    assert work_off(trusting) == [JobState.SUCCEEDED] * 2
    assert stored(trusting, caught["wrong"]).vector == package_of(trusting, uploads[1]).vector
    for name, by in (("right", "service"), ("wrong", "service"), ("other", "robot")):
        assert signed_by(trusting, caught[name]) == by
    assert told(trusting).count("frame.damaged") == 2
    assert list(check.fsck(trusting.settings)) == []


def test_nothing_of_a_wrong_key_is_used_any_more(
    trusting: Engine, uploads: Any, work_off: WorkOff, caught: dict[str, Added]
) -> None:
    added = add(trusting, uploads[4], package_of(trusting, uploads[4]))
    assert added.signed == "distrusted"
    work_off(trusting)
    assert signed_by(trusting, added) == "service"


def test_fsck_lists_what_is_left_of_a_wrong_key(
    trusting: Engine, work_off: WorkOff, caught: dict[str, Added]
) -> None:
    found = {one.finding.frame_id: one.finding.kind for one in check.fsck(trusting.settings)}
    left = {caught["right"].frame_id, caught["wrong"].frame_id}
    assert found == dict.fromkeys(left, "distrusted-signature")
    for one in check.fsck(trusting.settings, repair=True):
        assert one.done is not None
    work_off(trusting)
    assert list(check.fsck(trusting.settings)) == []


def test_a_key_found_wrong_while_a_frame_is_committed(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    added = add(trusting, uploads[0], moved(package_of(trusting, uploads[0])))
    claimed = trusting.claim("w")
    assert claimed is not None

    class Late(type(trusting.robot_signatures)):  # type: ignore[misc]
        """Looks before somebody else finds the key to be wrong."""

        def is_sampled(self, work: Any, sent: Any) -> bool:
            drawn: bool = super().is_sampled(work, sent)
            with trusting.store.database.write() as connection:
                distrust_sender(connection, sent.sender, "hall", "x")
            return drawn

    trusting.robot_signatures.__class__ = Late
    assert trusting.run(claimed) == JobState.QUEUED
    assert work_off(trusting) == [JobState.SUCCEEDED]
    assert signed_by(trusting, added) == "service"
    assert stored(trusting, added).vector == package_of(trusting, uploads[0]).vector


def test_a_signature_of_a_frame_that_cannot_be_signed(
    trusting: Engine, uploads: Any, work_off: WorkOff, flat: Any
) -> None:
    with pytest.raises(FrameError):
        package_of(trusting, flat)
    made = package_of(trusting, uploads[0])
    content = engine_content(trusting, flat)
    added = add(trusting, flat, replace(made, content_id=content))
    work_off(trusting)
    assert signed_by(trusting, added) == "robot"  # nobody looked

    sample_all(trusting)
    with trusting.store.database.write() as connection:
        distrust_sender(connection, key_id(trusting), "hall", "x")
    assert tidy(trusting) == 1
    before = trusting.get_map("hall").revision
    assert work_off(trusting) == [JobState.FAILED]
    frame = trusting.get_frame("hall", added.frame_id)
    assert (frame.state, frame.signed_by) == (FrameState.REJECTED, None)
    assert trusting.get_map("hall").revision > before
    assert list(check.fsck(trusting.settings)) == []


def test_a_sampled_frame_that_cannot_be_signed(
    trusting: Engine, uploads: Any, work_off: WorkOff, flat: Any
) -> None:
    sample_all(trusting)
    made = package_of(trusting, uploads[0])
    added = add(trusting, flat, replace(made, content_id=engine_content(trusting, flat)))
    assert work_off(trusting) == [JobState.FAILED]
    assert trusting.get_frame("hall", added.frame_id).state == FrameState.REJECTED
    with trusting.store.database.read() as connection:
        assert find_sender(connection, key_id(trusting)).distrusted_at is not None
    tidy(trusting)
    assert packages(trusting) == []
    assert usage(trusting) == (len(flat.data),) * 2


def engine_content(engine: Engine, upload: Any) -> str:
    return content_id(read_upload(upload.data, upload.meta, engine.store.decoders))


@pytest.fixture
def flat(make_upload: Any, uploads: Any) -> Any:
    """A frame of too few samples within reach for any pair of patches."""
    frame = replace(uploads[0].frame, pose=uploads[0].pose)
    depth = np.zeros_like(frame.depth)
    depth[:4, :4] = 1.0
    return make_upload(replace(frame, depth=depth), "room")


# jobs that end otherwise


def test_packages_of_jobs_that_ended_otherwise_go(
    trusting: Engine, uploads: Any, work_off: WorkOff
) -> None:
    first = add(trusting, uploads[0], package_of(trusting, uploads[0]))
    second = add(trusting, uploads[1], package_of(trusting, uploads[1]))
    blobs = [blob for blob, _ in packages(trusting)]
    trusting.delete_frame("hall", first.frame_id)
    cancel(trusting.store, second.job_id)
    assert len(blobs) == 2
    tidy(trusting)
    assert packages(trusting) == []
    assert not any(map(trusting.store.blobs.holds, blobs))
    assert usage(trusting) == (len(uploads[1].data),) * 2
    with trusting.store.database.read() as connection:
        assert not any(refers_to(connection, blob) for blob in blobs)


def test_a_map_goes_with_packages_that_wait(trusting: Engine, uploads: Any) -> None:
    add(trusting, uploads[0], package_of(trusting, uploads[0]))
    [(blob, _)] = packages(trusting)
    trusting.delete_map("hall")
    assert packages(trusting) == []
    assert not trusting.store.blobs.holds(blob)


def test_a_worker_that_dies_leaves_the_package_to_the_next(
    trusting: Engine, uploads: Any, work_off: WorkOff, due_now: Callable[[Engine], None]
) -> None:
    added = add(trusting, uploads[0], package_of(trusting, uploads[0]))
    assert trusting.claim("dies") is not None
    due_now(trusting)
    assert work_off(trusting) == [JobState.SUCCEEDED]
    assert signed_by(trusting, added) == "robot"


class Killed(BaseException):
    """Ends a worker where a test wants it to."""


@pytest.mark.parametrize("place", ["before the commit", "after the commit"])
def test_a_worker_that_is_killed_about_its_commit(
    trusting: Engine, uploads: Any, work_off: WorkOff, due_now: Callable[[Engine], None],
    place: str, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    added = add(trusting, uploads[0], package_of(trusting, uploads[0]))
    [(blob, _)] = packages(trusting)
    claimed = trusting.claim("dies")
    assert claimed is not None

    store = signature_job._store_patiently

    def die(*given: Any) -> None:
        if place == "after the commit":
            store(*given)
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(signature_job, "_store_patiently", die)
        with pytest.raises(Killed):
            trusting.run(claimed)
    assert trusting.store.blobs.holds(blob)
    due_now(trusting)
    done = work_off(trusting)
    assert done == ([JobState.SUCCEEDED] if place == "before the commit" else [])
    collect_doomed_blobs(trusting.store)
    assert signed_by(trusting, added) == "robot"
    tidy(trusting)
    assert packages(trusting) == []
    assert not trusting.store.blobs.holds(blob)
    assert usage(trusting) == (len(uploads[0].data),) * 2
    assert list(check.fsck(trusting.settings, grace_s=0)) == []


@pytest.mark.parametrize("place", ["before it is told", "after it is told"])
def test_a_worker_that_is_killed_as_it_finds_a_wrong_signature(
    trusting: Engine, uploads: Any, work_off: WorkOff, due_now: Callable[[Engine], None],
    place: str, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    earlier = add(trusting, uploads[1], moved(package_of(trusting, uploads[1])))
    work_off(trusting)
    sample_all(trusting)
    added = add(trusting, uploads[0], moved(package_of(trusting, uploads[0])))
    claimed = trusting.claim("dies")
    assert claimed is not None

    def die(*_: object) -> None:
        raise Killed

    of, name = {
        "before it is told": (RobotSignatures, "_distrust"),
        "after it is told": (signature_job, "_put"),
    }[place]
    with monkeypatch.context() as patch:
        patch.setattr(of, name, die)
        with pytest.raises(Killed):
            trusting.run(claimed)
    due_now(trusting)
    assert work_off(trusting) == [JobState.SUCCEEDED]
    tidy(trusting)
    assert work_off(trusting) == [JobState.SUCCEEDED]
    for one, upload in ((added, uploads[0]), (earlier, uploads[1])):
        assert signed_by(trusting, one) == "service"
        assert stored(trusting, one).vector == package_of(trusting, upload).vector
    assert packages(trusting) == []


def test_an_upload_that_is_replayed_says_what_it_said(trusting: Engine, uploads: Any) -> None:
    signed = write_package(package_of(trusting, uploads[0]))
    once = IdempotentRequest("cart", "k", "f" * 64)
    upload = Upload(uploads[0].data, uploads[0].meta, signed=signed, sender=key_id(trusting))
    first, again = trusting.uploads.add("hall", upload, once)
    assert (first.taken.signed, again) == ("kept", False)
    second, again = trusting.uploads.add("hall", upload, once)
    assert (second.taken, again) == (first.taken, True)


# what differs


def test_differences_of_what_was_sent(prepared: Any) -> None:
    signer = open_signer("depth")
    made, seen = prepared[0]

    def compare(vector: Any = made.vector, geometry: Any = seen) -> str:
        artifact = write_geometry(geometry)
        package = SignaturePackage(
            1, made.model_id, "ab" * 32, vector.tobytes(), made.n_patches, made.n_pairs, artifact
        )
        sent = SentSignature("key", package, read_geometry(artifact), 0)
        return difference(sent, made, seen, signer.model)

    assert compare() == ""
    rounded = made.vector.copy()
    rounded[::100] += 1
    assert compare(rounded) == ""
    assert "of the distance of unrelated frames" in compare(prepared[1][0].vector)

    surface, patches = seen.surface, seen.patches
    near = replace(surface, points=surface.points * np.float32(1.0005))
    assert compare(geometry=replace(seen, surface=near)) == ""
    far = replace(surface, points=surface.points * np.float32(1.05))
    assert compare(geometry=replace(seen, surface=far)) == "its surface is another"
    turned = replace(surface, normals=np.roll(surface.normals, 1, axis=-1))
    assert compare(geometry=replace(seen, surface=turned)) == "its surface is another"
    elsewhere = replace(patches, means=patches.means + 0.2)
    assert compare(geometry=replace(seen, patches=elsewhere)) == "its patches are others"
    others = replace(seen, descriptors=np.roll(seen.descriptors, 1, axis=0))
    assert compare(geometry=others) == "its descriptors are others"
    fewer = replace(
        seen, patches=patches_of(patches, slice(1, None)), descriptors=seen.descriptors[1:]
    )
    assert compare(geometry=fewer).startswith("it has ")


def patches_of(patches: Any, some: slice) -> Any:
    return replace(patches, **{name: value[some] for name, value in vars(patches).items()})
