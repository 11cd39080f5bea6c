"""The exceptions of sceneprint.

    SceneprintError, and all of sceneprint_client.errors
      x DamagedIndex            a cache file of the index is missing or damaged
      x DecoderFailure          a decoder crashes, or exceeds its time or memory
      x BusyIndex               another process is building this index
      x StoreError
        - LostLease             the lease of a job expired, and another worker claimed the job
        - BundleError           a bundle cannot be written or restored
          - DamagedBundle       the bytes of a bundle have changed
      x TrainingError           a model cannot be trained

The client raises the same classes, so `except sceneprint.errors.UnknownMap` catches its exceptions.
"""

from sceneprint_client.errors import (
    AmbiguousKey,
    Busy,
    CannotRetry,
    Conflict,
    DamagedBlob,
    DamagedSignature,
    DatasetError,
    Forbidden,
    ForeignOrigin,
    FrameConflict,
    FrameError,
    IdempotencyConflict,
    InvalidIntrinsics,
    InvalidPose,
    InvalidRequest,
    JobOver,
    JoinStands,
    KeyRequired,
    MalformedBody,
    MapExists,
    Misdirected,
    MissingDependency,
    ModelError,
    ModelMismatch,
    NewerSchema,
    NotFound,
    NotIndexed,
    PreconditionFailed,
    QuotaExceeded,
    RateLimited,
    ReadOnlyStore,
    Refused,
    SceneprintError,
    ServiceError,
    SlowBody,
    StoreAway,
    StoreError,
    StoreFull,
    StoreLocked,
    TooLarge,
    UnknownDeletion,
    UnknownFrame,
    UnknownJob,
    UnknownKey,
    UnknownMap,
    UnknownQuery,
    UnknownSession,
    UnknownTenant,
    Unreachable,
    UnreadableArchive,
    UnreadableCloud,
    UnreadableFrame,
    UnreadableGeometry,
    UnreadableModel,
    UnsupportedType,
    UnusableStore,
    UselessFrame,
    kebab_case,
)

__all__ = [
    "AmbiguousKey",
    "BundleError",
    "Busy",
    "BusyIndex",
    "CannotRetry",
    "Conflict",
    "DamagedBlob",
    "DamagedBundle",
    "DamagedIndex",
    "DamagedSignature",
    "DatasetError",
    "DecoderFailure",
    "Forbidden",
    "ForeignOrigin",
    "FrameConflict",
    "FrameError",
    "IdempotencyConflict",
    "InvalidIntrinsics",
    "InvalidPose",
    "InvalidRequest",
    "JobOver",
    "JoinStands",
    "KeyRequired",
    "LostLease",
    "MalformedBody",
    "MapExists",
    "Misdirected",
    "MissingDependency",
    "ModelError",
    "ModelMismatch",
    "NewerSchema",
    "NotFound",
    "NotIndexed",
    "PreconditionFailed",
    "QuotaExceeded",
    "RateLimited",
    "ReadOnlyStore",
    "Refused",
    "SceneprintError",
    "ServiceError",
    "SlowBody",
    "StoreAway",
    "StoreError",
    "StoreFull",
    "StoreLocked",
    "TooLarge",
    "TrainingError",
    "UnknownDeletion",
    "UnknownFrame",
    "UnknownJob",
    "UnknownKey",
    "UnknownMap",
    "UnknownQuery",
    "UnknownSession",
    "UnknownTenant",
    "Unreachable",
    "UnreadableArchive",
    "UnreadableCloud",
    "UnreadableFrame",
    "UnreadableGeometry",
    "UnreadableModel",
    "UnsupportedType",
    "UnusableStore",
    "UselessFrame",
    "kebab_case",
]


class DamagedIndex(SceneprintError):
    """A cache file of the index is missing or damaged."""


class DecoderFailure(SceneprintError):
    """A decoder crashed, took too long, or needed too much memory.

    The message is the predicate of a sentence; the caller prefixes the name of the upload.
    """


class BusyIndex(SceneprintError):
    """Another process is building this index."""


class LostLease(StoreError):
    """The lease of a job expired, and another worker claimed the job."""


class BundleError(StoreError):
    """A bundle cannot be written or restored."""


class DamagedBundle(BundleError):
    """The bytes of a bundle have changed."""


class TrainingError(SceneprintError):
    """A model cannot be trained on this data with these parameters."""
