"""The exceptions of sceneprint, for clients and internal.

    SceneprintError, and all of sceneprint_client.errors
      x DamagedIndex            a cache file of the index is missing or damaged
      x DecoderFailure          an upload crashes its decoder, or exceeds its limits
      x BusyIndex               another process is building this index
      x StoreError
        - LostLease             another worker has the job
        - BundleError           a bundle cannot be written or restored
          - DamagedBundle       the bytes of a bundle have changed
      x TrainingError           too little data, or parameters that cannot be fitted

The classes are shared, so `except sceneprint.errors.UnknownMap` catches exceptions of the client.
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
    """The lease of a job expired, and another worker has the job."""


class BundleError(StoreError):
    """A bundle cannot be written or restored."""


class DamagedBundle(BundleError):
    """The bytes of a bundle have changed."""


class TrainingError(SceneprintError):
    """A model cannot be trained on this data with these parameters."""
