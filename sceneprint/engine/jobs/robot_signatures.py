"""Signatures that robots sent with their frames: taken without signing, verified by sampling.

    package of a job  --RobotSignatures.open-->  SentSignature
    SentSignature  --is_sampled-->  taken as it is, or compared with what the worker makes

A sampled frame is signed here, and what was sent must agree. Where it does not, its sender is
trusted no more: what it sent is not used from then on, and upkeep has signed again whatever it sent
before.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.engine.ingest.frame_decoder import content_id, read_upload
from sceneprint.engine.jobs.lifecycle import Work, about
from sceneprint.engine.signers import Signers
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.engine.upkeep.repair import PAUSE_S, PRIORITY
from sceneprint.errors import DamagedBlob, InvalidRequest, SceneprintError, UnreadableGeometry
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.formats.signature_package import SignaturePackage, read_package, write_package
from sceneprint.geometry.retrieval.ranking import distance_share, distances
from sceneprint.geometry.surface.depth_image import halved, halvings
from sceneprint.models import Model
from sceneprint.pipeline import prepare
from sceneprint.process import span
from sceneprint.settings import Settings
from sceneprint.signing import SIGNING_VERSION, Signature
from sceneprint.store import Store, sender_rows
from sceneprint.store.events import record_event
from sceneprint.store.maps import find_map
from sceneprint.store.queue import enqueue
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.tables import FrameRow
from sceneprint.types import Floats, Floats32, Geometry, Intrinsics, Surface
from sceneprint_client.api import FrameMeta

log = logging.getLogger(__name__)

#: Signatures of a key that are all made here as well, before any is taken unseen.
FIRST = 16
#: Farthest that a signature may be from the one that is made here, as a share of the distance of
#: unrelated frames. Processors of one architecture give equal bytes; another may round a component
#: in a hundred otherwise. The nearest views of a map are ten times as far apart.
FARTHEST_SHARE = 0.02
#: The same of geometry whose bytes differ: of points, metres, and as many for each metre of range;
#: of unit normals; and of the bytes of descriptors, on average.
FARTHEST_POINT, FARTHEST_NORMAL, FARTHEST_DESCRIPTOR = 0.01, 0.05, 2.0
#: Least share of points and of patches that lie so near.
LEAST_SHARED = 0.99
#: Frames that are queued, and packages that are removed, in one transaction.
BLOCK = 200
#: Seconds between two looks for them.
EVERY_S = 5.0


@dataclass(frozen=True, eq=False)
class SentSignature:
    """What a robot made of a frame, decoded and found to be sound.

    Parameters
    ----------
    sender : id of the key that sent it
    package : its numbers and bytes
    geometry : its artifact, decoded
    verified : signatures of this sender that were made here as well, and agree
    """

    sender: str
    package: SignaturePackage
    geometry: Geometry
    verified: int


class RobotSignatures:
    """What is done with the packages of a store; safe to share between threads.

    Parameters
    ----------
    store : see Store
    settings : that say whether any is used, and what share of frames is signed here all the same
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store = store
        self._trusts, self._sample = settings.trust_signatures, settings.signed_sample
        self._tidied = -EVERY_S

    def open(self, work: Work, model: Model) -> tuple[SentSignature | None, str | None]:
        """What was sent with the frame of a job, if it can be used.

        Returns
        -------
        sent : None where nothing came, or it is of no use
        note : why it is of no use; None where nothing came
        """
        sender = (work.job.data or {}).get("sender")
        if sender is None or work.again:
            return None, None
        if not self._trusts:
            return None, "signatures of robots are not trusted"
        with span("package"):
            return self._read(work, model, sender)

    def _read(
        self, work: Work, model: Model, sender: str
    ) -> tuple[SentSignature | None, str | None]:
        """See `open`."""
        with self._store.database.read() as connection:
            blob = sender_rows.package_of(connection, work.job.number)
            known = sender_rows.find_sender(connection, sender)
        if known.distrusted_at is not None:
            return None, "an earlier signature of this key was wrong"
        if blob is None:
            return None, "it was removed"
        try:
            package = read_package(self._store.blobs.get(blob))
            geometry = checked(package, work.frame, model)
        except (DamagedBlob, InvalidRequest, UnreadableGeometry) as error:
            log.warning("robot's signature not usable", extra=about(work, error=str(error)))
            return None, f"it is not usable: {error}"
        return SentSignature(sender, package, geometry, known.verified), None

    def is_sampled(self, work: Work, sent: SentSignature) -> bool:
        """Whether a frame is signed here all the same.

        By the id of its job, which is made up anew with each upload: whoever deletes a frame and
        sends it again gains nothing from having seen what became of it.
        """
        return sent.verified < FIRST or self._store.seals.lot(work.job.id) < self._sample

    def verify(
        self, work: Work, sent: SentSignature, made: Signature | None, seen: Geometry | None,
        model: Model,
    ) -> bool:  # fmt: skip
        """Compare what was sent with what is made here, and trust its sender no more where they
        differ.

        Parameters
        ----------
        work, sent, model : see there
        made, seen : of the frame; None where nothing in it can be signed

        Returns
        -------
        agrees : whether they do
        """
        why = "nothing in the frame can be signed"
        if made is not None and seen is not None:
            why = difference(sent, made, seen, model)
        if why == "":
            with self._store.database.write(turn=False) as connection:
                sender_rows.add_verified(connection, sent.sender)
            return True
        self._distrust(work, sent.sender, why)
        return False

    def _distrust(self, work: Work, sender: str, why: str) -> None:
        map_name, frame_id = work.map.name, work.frame.id
        # beside no writer of any map: each looks in its own commit whether the sender is trusted
        with self._store.database.write() as connection:
            if not sender_rows.distrust_sender(connection, sender, map_name, frame_id):
                return
            name, _ = sender_rows.key_of(connection, sender) or ("", "")
            told: dict[str, Any] = {
                "name": name, "map": map_name, "frame_id": frame_id, "reason": why
            }  # fmt: skip
            record_event(connection, "key.distrusted", **told)
        log.error(
            "robot's signature is wrong; its key is trusted no more",
            extra=about(work, key=name, reason=why),
        )

    def tidy(self) -> int:
        """Remove packages of jobs that are over, and have frames signed again whose signatures came
        from a sender that is trusted no more, if it is time; returns how many frames were queued.
        """
        if time.monotonic() - self._tidied < EVERY_S or self._store.database.read_only:
            return 0
        self._tidied = time.monotonic()
        try:
            while self._remove_ended():
                pass
            queued = 0
            while (more := self._resign()) > 0:
                queued += more
        except SceneprintError as error:
            log.warning("robots' signatures not tidied", extra={"error": str(error)})
            return 0
        return queued

    def _remove_ended(self) -> bool:
        database, blobs = self._store.database, list[str]()
        with database.read() as connection:
            ended = sender_rows.ended_packages(connection, BLOCK)
        for map_number, numbers in ended.items():
            with database.write(map_number=map_number) as connection:
                blobs += sender_rows.remove_packages(connection, map_number, numbers)
        collect_deleted_blobs(self._store, blobs)
        return bool(blobs)

    def _resign(self) -> int:
        before = time.time() - PAUSE_S
        with self._store.database.read() as connection:
            if not sender_rows.distrusted_frames(connection, before, 1):
                return 0
        with self._store.database.write() as connection:
            found = sender_rows.distrusted_frames(connection, before, BLOCK)
            for one in found:
                job = enqueue(connection, REENCODE, one.number, PRIORITY, one.model_id)
                record_event(connection, "frame.damaged", one.map, one.id, job.id)
        log.warning("frames of a distrusted key queued for signing", extra={"frames": len(found)})
        return len(found)


def checked(package: SignaturePackage, frame: FrameRow, model: Model) -> Geometry:
    """The geometry of a package that is one of a frame and a model, as far as can be seen without
    signing.

    Parameters
    ----------
    package : as it was sent
    frame : that it came with
    model : of the frame's map

    Raises
    ------
    InvalidRequest : it is none; the text says why.
    UnreadableGeometry : its artifact cannot be read.
    """
    levels = len(model.levels)
    _require(package.signing_version == SIGNING_VERSION, "other signing code made it")
    _require(package.model_id == model.id, "another model made it")
    _require(package.content_id == frame.content_id, "it is of another frame")
    _require(len(package.vector) == model.signature_bytes, "its signature has another length")
    _require(
        len(package.n_patches) == levels
        and all(
            pairs <= patches * patches
            for patches, pairs in zip(package.n_patches, package.n_pairs, strict=True)
        )
        and package.n_pairs[0] > 0,
        "its counts of patches and pairs are none that a model makes",
    )
    geometry = read_geometry(package.artifact)
    _require(geometry.model_id == model.id, "its artifact is of another model")
    _require(
        geometry.descriptors.shape[1] == len(model.compression.matrix),
        "its descriptors have another length",
    )
    _require(_fits(geometry, frame, model), "its artifact is of another camera")
    # nothing but what our own writer writes is ever stored; all of its numbers are finite
    _require(write_geometry(geometry) == package.artifact, "its artifact is written otherwise")
    return geometry


def _fits(geometry: Geometry, frame: FrameRow, model: Model) -> bool:
    """Whether a surface was seen by the camera of a frame."""
    camera = geometry.surface.camera
    if frame.cloud is not None or frame.intrinsics is None:
        return not isinstance(camera, Intrinsics)
    given = frame.intrinsics
    expected = Intrinsics(
        given["width"], given["height"], given["fx"], given["fy"], given["cx"], given["cy"]
    )
    for _ in range(halvings(expected, model.parameters.depth)):
        expected = halved(expected)
    return camera == expected


def _require(held: bool, otherwise: str) -> None:
    if not held:
        raise InvalidRequest(otherwise, (("signed", otherwise),))


def difference(sent: SentSignature, made: Signature, seen: Geometry, model: Model) -> str:
    """How what was sent differs from what is made here; "" where it does not.

    Parameters
    ----------
    sent : of the robot
    made, seen : of the same frame, made here
    model : of both
    """
    vector = np.frombuffer(sent.package.vector, np.uint8)
    apart = distances(vector, made.vector[None], model.metric)[0]
    share = float(distance_share(apart, model.unrelated_distance, model.metric))
    if share > FARTHEST_SHARE:
        return f"its signature is at {share:.3f} of the distance of unrelated frames"
    artifact = write_geometry(seen)
    if artifact == sent.package.artifact:
        return ""
    # as it is read back: of the same precision
    return _geometry_difference(sent.geometry, read_geometry(artifact))


def _geometry_difference(sent: Geometry, made: Geometry) -> str:
    if _are_others(sent.surface, made.surface):
        return "its surface is another"
    spread = sent.surface.spread, made.surface.spread
    if spread[0] is not None and spread[1] is not None and _are_others(spread[0], spread[1]):
        return "its spread points are others"
    p, q = sent.patches, made.patches
    if (len(p), spread[0] is None) != (len(q), spread[1] is None):
        return f"it has {len(p)} patches, not {len(q)}"
    if _near(p.means, q.means, p.normals, q.normals).mean() < LEAST_SHARED:
        return "its patches are others"
    apart = np.abs(sent.descriptors.astype(int) - made.descriptors.astype(int))
    return "its descriptors are others" if apart.mean() > FARTHEST_DESCRIPTOR else ""


def _are_others(sent: Surface, made: Surface) -> bool:
    if sent.camera != made.camera or sent.points.shape != made.points.shape:
        return True
    both, either = sent.valid & made.valid, sent.valid | made.valid
    near = both & _near(sent.points, made.points, sent.normals, made.normals)
    return bool(near.sum() < LEAST_SHARED * either.sum())


def _near(
    points: Floats | Floats32, others: Floats | Floats32, normals: Floats | Floats32,
    other_normals: Floats | Floats32,
) -> NDArray[np.bool_]:  # fmt: skip
    """Which points (..., 3) lie near others, with normals that are."""
    limit = FARTHEST_POINT * (1.0 + np.linalg.norm(others, axis=-1))
    found: NDArray[np.bool_] = (np.linalg.norm(points - others, axis=-1) <= limit) & (
        np.linalg.norm(normals - other_normals, axis=-1) <= FARTHEST_NORMAL
    )
    return found


def make_package(
    store: Store, signers: Signers, map_name: str, data: bytes, meta: FrameMeta
) -> bytes:
    """What signing makes of a frame with a map's model, to be sent with the frame to a map of the
    same model; nothing is stored.

    Parameters
    ----------
    store, signers : see there
    map_name : of the map
    data, meta : the frame, as it will be sent

    Raises
    ------
    UnknownMap : no such map.
    InvalidRequest, FrameError : see `read_upload`; or nothing in the frame can be signed.
    """
    with store.database.read() as connection:
        model_id = find_map(connection, map_name).model_id
    read = read_upload(data, meta, store.decoders)
    made, seen = prepare(read.frame, signers(model_id))
    package = SignaturePackage(
        SIGNING_VERSION, model_id, content_id(read), made.vector.tobytes(), made.n_patches,
        made.n_pairs, write_geometry(seen),
    )  # fmt: skip
    return write_package(package)
