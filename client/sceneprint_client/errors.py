"""Errors that sceneprint raises deliberately, with their common base class.

    SceneprintError
      x FrameError              the caller's frame is invalid; a retry cannot help
        - UnreadableFrame       the bytes do not decode to a depth image
        - UnreadableCloud       the bytes do not decode to a point cloud
        - InvalidIntrinsics     the intrinsics do not describe a camera
        - InvalidPose           the pose is not a rigid transform
        - UselessFrame          the frame decodes, but has no surface to sign
        - UnreadableArchive     a file of many frames is not an archive, or is unsafe to read
      x DatasetError            a folder or file is not a sequence of frames
      x ModelError
        - UnreadableModel       a file is not a model, or has another schema
        - ModelMismatch         signatures or artifacts of two models were compared
      x UnreadableGeometry      a geometry artifact is missing, damaged or has another schema
      x NotFound                the requested object does not exist
        - UnknownMap, UnknownFrame, UnknownSession, UnknownJob, UnknownQuery
        - UnknownKey            there is no key of that name
        - UnknownTenant         there is no tenant of that name
        - UnknownDeletion       there is no such deletion, or it can no longer be undone
      x Conflict                the request contradicts stored data
        - MapExists             a map of that name has other properties
        - FrameConflict         the same content has other metadata
        - JobOver               a finished job cannot be cancelled
        - CannotRetry           a job cannot be retried
        - JoinStands            poses depend on the join of an association
        - NotIndexed            the result of a frame or job does not exist yet
      x InvalidRequest          a field of a request is missing, unknown or out of range
        - MalformedBody         the body cannot be parsed
        - UnsupportedType       the operation does not read bodies of this type
        - TooLarge              the body exceeds the limit of the service
        - SlowBody              the body arrived too slowly
        - AmbiguousKey          the request has more than one Authorization header
        - IdempotencyConflict   the Idempotency-Key was used for another request
      x PreconditionFailed      the object was edited after the caller read it
      x KeyRequired             the service requires a key; it is missing or invalid
      x Forbidden               the key lacks the required scope
      x QuotaExceeded           the map has reached its quota of frames or bytes
      x RateLimited             the caller sends too many requests; retry later
      x Misdirected             the request is addressed to another host
      x ForeignOrigin           a page of another host sent the request
      x Busy                    the queue of requests is full; retry later
      x StoreError
        - UnusableStore         the folder or database cannot be opened or written
          - StoreFull           the disk is full
          - ReadOnlyStore       the folder or database is read-only
          - StoreLocked         another process has locked the database for too long
          - StoreAway           the database or blob server does not answer
        - NewerSchema           a later version of sceneprint wrote the database
        - DamagedBlob           stored bytes are missing or damaged
        - DamagedSignature      the checksum of a stored signature does not match
      x ServiceError            a service refused a request or is unreachable
        - Unreachable           the service did not answer
        - Refused               the answer is a problem document
      x MissingDependency       an optional library is missing

A message says what happened, why, and what to do. Commands print it on one line and exit with
code 2. `ValueError` and `TypeError` indicate mistakes in the calling program.
"""

import re


def kebab_case(name: str) -> str:
    """Convert a class name to the last part of a problem's type: UnknownMap to unknown-map."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower()


class SceneprintError(Exception):
    """Base of every error that is raised deliberately."""

    #: Delay before a retry that the service requests (`Retry-After`), seconds; 0 if unspecified.
    retry_after_s: float = 0.0


def printable(text: str) -> str:
    """Return text from a file as one printable line; damaged files may contain any characters."""
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
    """The frame decodes, but has no surface to sign."""


class UnreadableArchive(FrameError):
    """The bytes are not an archive of frames, or are unsafe to read."""


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
    """The object that the request names does not exist."""


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
    """The job has ended, so it cannot be cancelled."""


class CannotRetry(Conflict):
    """The job has not ended, its frame has a later job, or there is nothing to retry."""


class JoinStands(Conflict):
    """The poses of a map depend on the join of an association, which cannot be deleted yet."""


class NotIndexed(Conflict):
    """The frame is not indexed, or the job has not succeeded, so the result does not exist yet."""


class PreconditionFailed(SceneprintError):
    """The object was changed after you read it."""


class InvalidRequest(SceneprintError):
    """A field of a request is missing, unknown or out of range.

    Parameters
    ----------
    message : description of what happened, why, and what to do
    fields : (name, reason) of each invalid field
    """

    def __init__(self, message: str, fields: tuple[tuple[str, str], ...] = ()) -> None:
        super().__init__(message)
        self.fields = fields


class MalformedBody(InvalidRequest):
    """The body of a request cannot be parsed."""


class UnsupportedType(InvalidRequest):
    """The operation does not read request bodies of this type."""


class TooLarge(InvalidRequest):
    """The body of a request exceeds the limit of the service."""


class SlowBody(InvalidRequest):
    """The body of a request arrived too slowly."""


class AmbiguousKey(InvalidRequest):
    """The request has more than one Authorization header."""


class IdempotencyConflict(InvalidRequest):
    """The Idempotency-Key of the request was used for another request."""


class KeyRequired(SceneprintError):
    """The service requires a key, and the request has no valid key."""


class Forbidden(SceneprintError):
    """The key of the request lacks the required scope."""


class QuotaExceeded(SceneprintError):
    """The map has reached its quota of frames or of uploaded bytes."""


class RateLimited(SceneprintError):
    """The caller exceeds its request rate."""


class Misdirected(SceneprintError):
    """The request is addressed to another host."""


class ForeignOrigin(SceneprintError):
    """A page of another host sent the request."""


class Busy(SceneprintError):
    """The queue of requests is full."""


class StoreError(SceneprintError):
    """The store failed."""


class UnusableStore(StoreError):
    """The folder or database cannot be opened or written."""


class StoreFull(UnusableStore):
    """The disk is full."""


class ReadOnlyStore(UnusableStore):
    """The folder or database can be read, but not written."""


class StoreLocked(UnusableStore):
    """Another process has locked the database for too long."""


class StoreAway(UnusableStore):
    """The database or blob server does not answer, or the connection was lost."""


class NewerSchema(UnusableStore):
    """A later version of sceneprint wrote the database, so this version must not write to it."""


class DamagedBlob(StoreError):
    """Stored bytes are missing or damaged."""


class DamagedSignature(StoreError):
    """The checksum of a stored signature does not match."""


class ServiceError(SceneprintError):
    """A service refused a request or could not be reached."""


class Unreachable(ServiceError):
    """The service did not answer."""


class Refused(ServiceError):
    """The service answered with a problem document.

    Parameters
    ----------
    message : `detail` of the problem document
    status : HTTP status
    problem : problem document
    """

    def __init__(self, message: str, status: int, problem: dict[str, object]) -> None:
        super().__init__(message)
        self.status = status
        self.problem = problem


class MissingDependency(SceneprintError):
    """A library that this operation needs cannot be imported."""
