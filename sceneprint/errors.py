"""Everything sceneprint raises on purpose: what a client may meet, and what stays inside.

    SceneprintError, and all of sceneprint_client.errors
      x DamagedIndex            a cache file of the index that is missing or damaged
      x DecoderFailure          an upload that crashes its decoder, or exceeds its limits
      x BusyIndex               another process is building this index
      x StoreError
        - LostLease             the job has been given to another worker
        - BundleError           a bundle cannot be written, or not be restored there
          - DamagedBundle       its bytes are not those that were written
      x TrainingError           too little data, or parameters that cannot be fitted

They are the same classes: `except sceneprint.errors.UnknownMap` catches what a client raises.
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
    """A decoder crashed of an upload, took too long, or needed too much memory. Its text goes on
    from "it": who catches it says of what.
    """


class BusyIndex(SceneprintError):
    """Another process is building this index."""


class LostLease(StoreError):
    """The job's lease ran out, and it has been given to another worker."""


class BundleError(StoreError):
    """A bundle cannot be written, or cannot be restored there."""


class DamagedBundle(BundleError):
    """The bytes of a bundle are not those that were written."""


class TrainingError(SceneprintError):
    """A model cannot be trained from this data with these parameters."""
