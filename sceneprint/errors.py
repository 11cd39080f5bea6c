"""Define the exceptions of sceneprint: those that clients see, and internal ones.

    SceneprintError, and all of sceneprint_client.errors
      x DamagedIndex            a cache file of the index is missing or damaged
      x DecoderFailure          an upload crashes its decoder, or exceeds its limits
      x BusyIndex               another process is building this index
      x StoreError
        - LostLease             another worker has the job
        - BundleError           a bundle cannot be written, or cannot be restored there
          - DamagedBundle       its bytes are not the original ones
      x TrainingError           too little data, or parameters that cannot be fitted

The classes are shared: `except sceneprint.errors.UnknownMap` catches exceptions of the client.
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

    Its message continues a sentence from "it": the caller names the upload.
    """


class BusyIndex(SceneprintError):
    """Another process is building this index."""


class LostLease(StoreError):
    """The job's lease expired, and another worker has the job."""


class BundleError(StoreError):
    """A bundle cannot be written, or cannot be restored there."""


class DamagedBundle(BundleError):
    """The bytes of a bundle are not the original ones."""


class TrainingError(SceneprintError):
    """A model cannot be trained from this data with these parameters."""
