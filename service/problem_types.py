"""Table of problem types: status code, remedy and public text of each error."""

from __future__ import annotations

from typing import NamedTuple


class ProblemType(NamedTuple):
    """A type of problem document.

    Parameters
    ----------
    status : HTTP status code
    remedy : instruction in docs/reference.md
    meaning : description; default: docstring of the error class
    retry_after_s : value of the header Retry-After: short under load, longer if a person must act
        first
    detail : text for clients that replaces the message of the error, which contains paths that only
        the operator should know
    """

    status: int
    remedy: str
    meaning: str = ""
    retry_after_s: int | None = None
    detail: str = ""


_LOG = "Its log has the details under the id of the request."
#: Problem types by error class; other classes inherit the type of their nearest base class. Names
#: without a class are problems that the framework detects.
PROBLEM_TYPES = {
    "MalformedBody": ProblemType(
        400, "Send valid JSON, or a form, with the right `Content-Type`."
    ),
    "AmbiguousKey": ProblemType(400, "Send one `Authorization` header."),
    "KeyRequired": ProblemType(
        401, "Send `Authorization: Bearer KEY` with a valid key. It is required on loopback "
        "addresses too, if a proxy forwards the request."
    ),
    "Forbidden": ProblemType(403, "Use a key with the scope that `detail` names."),
    "QuotaExceeded": ProblemType(403, "Delete frames, or ask the operator for a larger quota."),
    "ForeignOrigin": ProblemType(
        403, "Ask the operator to list the page's origin in `SCENEPRINT_CORS_ORIGINS`."
    ),
    "NotFound": ProblemType(404, "Check the path, name or id. A key sees only what it may read."),
    "UnknownQuery": ProblemType(404, "Repeat the query, and keep answers that you need later."),
    "UnknownDeletion": ProblemType(404, "Upload the frames again."),
    "MethodNotAllowed": ProblemType(
        405, "`Allow` lists the methods of the path.", "The path does not have this method."
    ),
    "NotAcceptable": ProblemType(
        406, "Omit `Accept`.", "`Accept` names no type that the operation returns."
    ),
    "SlowBody": ProblemType(
        408, "Send the body faster: within 30 s plus 4 s for each MiB, without pauses of 10 s."
    ),
    "Conflict": ProblemType(409, "Compare the request with the stored object."),
    "MapExists": ProblemType(409, "Use the map as it is, or another name."),
    "FrameConflict": ProblemType(409, "Change the metadata of the stored frame with PATCH."),
    "JobOver": ProblemType(409, "Read the job to see how it ended."),
    "CannotRetry": ProblemType(
        409, "Wait until the job is over; upload the frame again if it has a later job."
    ),
    "JoinStands": ProblemType(409, "Undo the join of the association first."),
    "NotIndexed": ProblemType(
        409, "Wait until the frame is `indexed` or the job has succeeded."
    ),
    "PreconditionFailed": ProblemType(
        412, "Read the object again, and repeat the edit with the new ETag."
    ),
    "TooLarge": ProblemType(
        413, "Send a smaller body (JSON: at most 256 KiB), or ask the operator to raise "
        "`SCENEPRINT_MAX_UPLOAD_BYTES` or `SCENEPRINT_MAX_IMPORT_BYTES`."
    ),
    "UnsupportedType": ProblemType(
        415, "Send a `Content-Type` that the operation lists, without `Content-Encoding`."
    ),
    "RangeNotSatisfiable": ProblemType(
        416, "Request a range within the file.", "The file is shorter than `Range`."
    ),
    "Misdirected": ProblemType(
        421, "Address the service as `localhost`, and configure any proxy to set `Host` to that."
    ),
    "InvalidRequest": ProblemType(422, "Correct the fields that `errors` lists."),
    "IdempotencyConflict": ProblemType(422, "Use a new key for each different request."),
    "FrameError": ProblemType(422, "Follow `detail`; do not repeat the request unchanged."),
    "RateLimited": ProblemType(
        429, "Wait as long as `Retry-After` says, and repeat.", retry_after_s=1
    ),
    "SceneprintError": ProblemType(500, "Find the request's id in the log, and report it."),
    "DamagedBlob": ProblemType(500, "Ask the operator to run `sceneprint fsck --repair`."),
    "DamagedSignature": ProblemType(500, "Ask the operator to run `sceneprint fsck --repair`."),
    "InternalError": ProblemType(
        500, "Report it with the traceback that the log has under the request's id.",
        "The service failed; nothing was partially written."
    ),
    "Busy": ProblemType(503, "Wait as long as `Retry-After` says, and repeat.", retry_after_s=1),
    "UnusableStore": ProblemType(
        503, "Retry later.", retry_after_s=1,
        detail=f"The service cannot use its store at the moment, so nothing was stored. {_LOG} "
        "Retry later.",
    ),
    "StoreLocked": ProblemType(
        503, "Retry later. The operator must stop the process that has locked the database.",
        retry_after_s=1,
        detail="Another process has locked the service's store for too long, so nothing was "
        f"stored. Queries still work. {_LOG} Retry later.",
    ),
    "StoreAway": ProblemType(
        503,
        "Repeat the request. It may have been stored already; repeating it is safe.",
        retry_after_s=1,
        detail="The service's database or object store does not respond. The request may or may "
        f"not have been stored; it is safe to send it again. {_LOG} Retry later.",
    ),
    "ReadOnlyStore": ProblemType(
        503, "The operator must make the data folder writable, and restart the service.",
        retry_after_s=60,
        detail="The service's store is read-only, so nothing was stored. Queries still work. "
        f"{_LOG} Make the data folder writable there, and restart the service.",
    ),
    "NewerSchema": ProblemType(
        503, "The operator must start the version that migrated the database.", retry_after_s=60,
        detail="A later version of sceneprint has migrated the service's store, so this process "
        f"stored nothing. {_LOG} Stop the process, and start the later version.",
    ),
    "StoreFull": ProblemType(
        507, "The operator must free disk space. Queries still work.", retry_after_s=30,
        detail="The service's disk is full, so nothing was stored. Queries still work. "
        f"{_LOG} Free some space there, and send the request again.",
    ),
}  # fmt: skip


def problem_type(kind: type[BaseException]) -> ProblemType:
    """Return the problem type of an error class."""
    return next(
        PROBLEM_TYPES[base.__name__] for base in kind.__mro__ if base.__name__ in PROBLEM_TYPES
    )
