"""Everything that a client of sceneprint raises on purpose, and the base of all its errors.

    SceneprintError
      x FrameError              the caller's frame cannot be used; trying again cannot help
        - UnreadableFrame       its bytes do not decode to a depth image
        - UnreadableCloud       its bytes do not decode to a point cloud
        - InvalidIntrinsics     its camera is not a camera
        - InvalidPose           its pose is not a rigid transform
        - UselessFrame          it decodes, but there is nothing in it to sign
        - UnreadableArchive     a file of many frames that is none, or is not safe to read
      x DatasetError            a folder or file that is no sequence of frames
      x ModelError
        - UnreadableModel       a model file that is none, or of another schema
        - ModelMismatch         signatures or artifacts of two models were compared
      x UnreadableGeometry      a geometry artifact that is missing, damaged or of another schema
      x NotFound                there is no such map, frame or job
        - UnknownMap, UnknownFrame, UnknownSession, UnknownJob, UnknownQuery
        - UnknownKey            there is no key of that name
        - UnknownTenant         there is no tenant of that name
        - UnknownDeletion       there is no deletion that could be undone
      x Conflict                the request contradicts what is there
        - MapExists             a map of that name, made otherwise
        - FrameConflict         the same content with other metadata
        - JobOver               a job that is over cannot be cancelled
        - CannotRetry           a job that cannot be tried again
        - JoinStands            poses follow from the join of an association, which has to stay
        - NotIndexed            a frame or job that has not made yet what is asked of it
      x InvalidRequest          a field of a request is missing, unknown or out of its range
        - MalformedBody         its body cannot be parsed at all
        - UnsupportedType       its body is of a type that is not read
        - TooLarge              its body is larger than the service takes
        - SlowBody              its body came too slowly
        - AmbiguousKey          it has more than one Authorization header
        - IdempotencyConflict   its Idempotency-Key was used for something else
      x PreconditionFailed      what is to be edited has been edited meanwhile
      x KeyRequired             the service asks for a key, and none or a wrong one was given
      x Forbidden               the key that was shown may not do this
      x QuotaExceeded           the map holds as many frames or bytes as its quota allows
      x RateLimited             this caller asks too often; come back
      x Misdirected             the request is meant for another host than this machine
      x ForeignOrigin           a page of another host sent the request
      x Busy                    as many requests wait as may; come back
      x StoreError
        - UnusableStore         the folder or database cannot be opened or written
          - StoreFull           the disk has no room for what should be stored
          - ReadOnlyStore       the folder or database may be read, and not written
          - StoreLocked         another process has kept the database from writers for long
        - NewerSchema           a later version of sceneprint wrote it
        - DamagedBlob           stored bytes are missing or are not those that were stored
        - DamagedSignature      a stored signature's checksum does not fit
      x ServiceError            what a client is told by, or of, a service
        - Unreachable           no answer came
        - Refused               the answer is a problem document
      x MissingDependency       an optional part of the machine is absent

A message says what happened, why, and what to do. Commands print it on one line
and end with exit code 2. `ValueError` and `TypeError` stay what they are in Python:
a mistake of the programmer who calls.
"""

import re


def kebab_case(name: str) -> str:
    """The name of a class as it stands in the type of a problem: UnknownMap is unknown-map."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()


class SceneprintError(Exception):
    """Base of every error raised on purpose."""

    #: Seconds after which a service asked to come back (`Retry-After`); 0 if it did not ask.
    retry_after_s: float = 0.0


def printable(text: str) -> str:
    """A text from outside as it can stand in a line: names in damaged files may be anything."""
    return text if text.isprintable() else ascii(text)[1:-1]


class FrameError(SceneprintError):
    """The caller's frame cannot be used."""


class UnreadableFrame(FrameError):
    """The bytes do not decode to a depth image."""


class UnreadableCloud(FrameError):
    """The bytes do not decode to a point cloud."""


class InvalidIntrinsics(FrameError):
    """The intrinsics do not describe a camera."""


class InvalidPose(FrameError):
    """The pose is not a rigid transform."""


class UselessFrame(FrameError):
    """The frame decodes, but holds nothing that can be signed."""


class UnreadableArchive(FrameError):
    """The bytes are not an archive of frames, or are not safe to read."""


class DatasetError(SceneprintError):
    """The folder or file is not a sequence of frames."""


class ModelError(SceneprintError):
    """A model cannot be used."""


class UnreadableModel(ModelError):
    """The file is not a model, is damaged, or has another schema."""


class ModelMismatch(ModelError):
    """Signatures or artifacts of two models were compared."""


class UnreadableGeometry(SceneprintError):
    """The bytes are not a geometry artifact, are damaged, or have another schema."""


class NotFound(SceneprintError):
    """What the request names does not exist."""


class UnknownMap(NotFound):
    """There is no map with that name."""


class UnknownFrame(NotFound):
    """There is no frame with that id in the map."""


class UnknownSession(NotFound):
    """The map has no frame of that session."""


class UnknownJob(NotFound):
    """There is no job with that id."""


class UnknownKey(NotFound):
    """There is no key with that name."""


class UnknownTenant(NotFound):
    """There is no tenant with that name."""


class UnknownQuery(NotFound):
    """There is no answer with that id, or it has expired."""


class UnknownDeletion(NotFound):
    """There is no deletion with that id, or it can no longer be undone."""


class Conflict(SceneprintError):
    """The request contradicts what is stored."""


class MapExists(Conflict):
    """A map with that name exists, but has another title or model."""


class FrameConflict(Conflict):
    """The map has a frame with the same content and other metadata."""


class JobOver(Conflict):
    """The job is over, and cannot be cancelled any more."""


class CannotRetry(Conflict):
    """The job is not over, its frame has a later job, or there is nothing to retry."""


class JoinStands(Conflict):
    """The poses of a map follow from the join of an association, which has to stay."""


class NotIndexed(Conflict):
    """The frame is not indexed, or the job has not succeeded, so the result does not exist yet."""


class PreconditionFailed(SceneprintError):
    """The object was changed after you read it."""


class InvalidRequest(SceneprintError):
    """A field of a request is missing, unknown or out of its range.

    Parameters
    ----------
    message : what, why, and what to do
    fields : (place, reason) of each field at fault
    """

    def __init__(self, message: str, fields: tuple[tuple[str, str], ...] = ()) -> None:
        super().__init__(message)
        self.fields = fields


class MalformedBody(InvalidRequest):
    """The body of a request cannot be parsed."""


class UnsupportedType(InvalidRequest):
    """The body of a request has a type that the operation does not read."""


class TooLarge(InvalidRequest):
    """The body of a request is larger than the service takes."""


class SlowBody(InvalidRequest):
    """The body of a request came too slowly."""


class AmbiguousKey(InvalidRequest):
    """The request has more than one Authorization header."""


class IdempotencyConflict(InvalidRequest):
    """The request's Idempotency-Key was used for another one."""


class KeyRequired(SceneprintError):
    """The service requires a key, and the request has none, or one that is unknown, revoked or
    expired.
    """


class Forbidden(SceneprintError):
    """The key of the request lacks the scope for it."""


class QuotaExceeded(SceneprintError):
    """The map holds as many frames, or bytes of uploads, as its quota allows."""


class RateLimited(SceneprintError):
    """The caller sends more requests than it may."""


class Misdirected(SceneprintError):
    """The request is meant for another host than this machine."""


class ForeignOrigin(SceneprintError):
    """A page of another host sent the request."""


class Busy(SceneprintError):
    """The queue of waiting requests is full."""


class StoreError(SceneprintError):
    """The store failed."""


class UnusableStore(StoreError):
    """The folder or database cannot be opened or written."""


class StoreFull(UnusableStore):
    """The disk has no room for what should be stored."""


class ReadOnlyStore(UnusableStore):
    """The folder or database can be read, but not written."""


class StoreLocked(UnusableStore):
    """Another process has locked the database for too long."""


class StoreAway(UnusableStore):
    """The server of the database, or of the blobs, does not answer, or the connection was lost."""


class NewerSchema(UnusableStore):
    """A later version of sceneprint wrote the database, and this one may not write to it."""


class DamagedBlob(StoreError):
    """Stored bytes are missing, or are not those that were stored."""


class DamagedSignature(StoreError):
    """A stored signature differs from the one that was stored."""


class ServiceError(SceneprintError):
    """A service refused a request, or could not be reached."""


class Unreachable(ServiceError):
    """No answer came from the service."""


class Refused(ServiceError):
    """The service answered with a problem document.

    Parameters
    ----------
    message : its detail
    status : of HTTP
    problem : the document
    """

    def __init__(self, message: str, status: int, problem: dict[str, object]) -> None:
        super().__init__(message)
        self.status = status
        self.problem = problem


class MissingDependency(SceneprintError):
    """A library that this task needs cannot be imported on this machine."""
