"""The page of errors of the service, the client and the command line."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

from sceneprint import errors
from sceneprint.errors import SceneprintError
from service.problems import STATUSES, phrase, type_of
from tools.site.markup import cell, code, page, table

#: Remedies by error class; other classes have that of their nearest base.
REMEDIES: dict[type[SceneprintError], str] = {
    errors.FrameError: "Do not repeat the request: nothing was stored. `detail` names the fault.",
    errors.UnreadableFrame: "Send a 16-bit greyscale PNG, or a two-dimensional NPY.",
    errors.UnreadableCloud: "Send PLY, PCD, LAS, LAZ, NPY or PointCloud2. For the `.bin` of KITTI, "
    "send `format=kitti` as well.",
    errors.InvalidIntrinsics: "Send `fx`, `fy`, `cx`, `cy` in pixels of this image.",
    errors.InvalidPose: "Send a finite translation in metres and a unit quaternion.",
    errors.UselessFrame: "Take the frame where more surface is in the sensor's range.",
    errors.UnreadableArchive: "Send a ZIP or TAR archive of a folder of frames.",
    errors.NotFound: "Check the name or id. A key sees only what it may read.",
    errors.UnknownQuery: "Repeat the query, or keep answers that you look at later.",
    errors.UnknownDeletion: "Deletions can be undone for `SCENEPRINT_UNDO_WINDOW_S` seconds. "
    "Upload the frames again.",
    errors.Conflict: "Read what is stored, and decide which of the two you want.",
    errors.MapExists: "Use the map as it is, or another name.",
    errors.FrameConflict: "Change the metadata of the stored frame with PATCH.",
    errors.JobOver: "Nothing: read the job to see how it ended.",
    errors.CannotRetry: "Wait until the job is over; upload the frame again if it has a later job.",
    errors.JoinStands: "Undo the join of the association first, if its poses are to go back.",
    errors.NotIndexed: "Wait until the frame is `indexed` or the job has succeeded, and ask again.",
    errors.PreconditionFailed: "Read it again, and repeat the edit with the new ETag.",
    errors.InvalidRequest: "Correct the fields that `errors` lists.",
    errors.MalformedBody: "Send valid JSON, or a form, with the right `Content-Type`.",
    errors.UnsupportedType: "Send a `Content-Type` that the operation lists.",
    errors.TooLarge: "Send less, or ask the operator to raise `SCENEPRINT_MAX_UPLOAD_BYTES` or "
    "`SCENEPRINT_MAX_IMPORT_BYTES`.",
    errors.SlowBody: "Send the body without pauses, or over a faster network.",
    errors.AmbiguousKey: "Send one `Authorization` header.",
    errors.IdempotencyConflict: "Use a new Idempotency-Key for each different request.",
    errors.KeyRequired: "Send `Authorization: Bearer KEY` with a key that has not expired.",
    errors.Forbidden: "Use a key with the scope that `detail` names.",
    errors.QuotaExceeded: "Delete frames, or ask the operator for a larger quota.",
    errors.ForeignOrigin: "Have the operator list the page's origin in `SCENEPRINT_CORS_ORIGINS`.",
    errors.Misdirected: "Address the service as `localhost`; let a proxy set `Host` to that.",
    errors.RateLimited: "Wait for the seconds in `Retry-After`.",
    errors.Busy: "Wait for the seconds in `Retry-After`, and repeat the request.",
    errors.UnusableStore: "Operator: see the log under the request's id. Caller: retry later.",
    errors.StoreFull: "Operator: free disk space. Queries still work.",
    errors.ReadOnlyStore: "Operator: make the data folder writable, and restart the service.",
    errors.StoreLocked: "Operator: end the process that holds the database. Caller: retry later.",
    errors.StoreAway: "Repeat the request: whether it was stored or not, that is safe.",
    errors.SceneprintError: "Operator: see the log under the request's id, and report it.",
    errors.DamagedBlob: "Operator: run `sceneprint fsck --repair`.",
    errors.DamagedSignature: "Operator: run `sceneprint fsck --repair`.",
    errors.DamagedIndex: "Nothing: workers build the index again.",
    errors.BusyIndex: "Wait until the other process has built the index.",
    errors.DamagedBundle: "Restore another bundle; this one was damaged after it was written.",
    errors.BundleError: "Follow the message: most often the target folder is not empty.",
    errors.NewerSchema: "Use a version of sceneprint that is at least as new as the database.",
    errors.LostLease: "Nothing: another worker does the job.",
    errors.ModelError: "Use a model that `GET /v1/models` lists.",
    errors.UnreadableModel: "Copy the model's file again, or train it again.",
    errors.ModelMismatch: "Compare frames of one map, or have a map signed again: "
    "`sceneprint reencode`.",
    errors.UnreadableGeometry: "Upload the frame again, or have its map signed again.",
    errors.DatasetError: "Check the folder's layout; the message names the file.",
    errors.TrainingError: "Give more frames, or the parameters that the message names.",
    errors.MissingDependency: "Install the packages that the message names.",
    errors.ServiceError: "Check the address, and whether the service runs: `sceneprint doctor`.",
    errors.Refused: "See `status` and `problem` of the error, and the table above.",
}
#: Problems without an error class: status, kind, meaning, remedy.
OTHERS = (
    (400, "BadRequest", "The request is not HTTP.", "Use an HTTP client."),
    (404, "NotFound", "No operation has this path.", "Check the path against the operations."),
    (405, "MethodNotAllowed", "The path does not support this method.",
     "`Allow` lists the methods that it supports."),
    (406, "NotAcceptable", "`Accept` names no type that the operation returns.",
     "Omit `Accept`."),
    (416, "RangeNotSatisfiable", "`Range` starts beyond the end of the file.",
     "Request a range within the file."),
    (500, "InternalError", "The service failed; nothing was partially written.",
     "Report it with the traceback that the log has under the request's id."),
)  # fmt: skip


def kinds() -> list[type[SceneprintError]]:
    """Return all public error classes, without their common base."""
    found = [getattr(errors, name) for name in errors.__all__ if name[:1].isupper()]
    return [one for one in found if one is not SceneprintError]


def status(kind: type[SceneprintError]) -> int:
    """Return the HTTP status of an error in an answer of the service."""
    return next(STATUSES[base] for base in kind.__mro__ if base in STATUSES)


def remedy(kind: type[SceneprintError]) -> str:
    """Return the remedy for an error."""
    return next(REMEDIES[base] for base in kind.__mro__ if base in REMEDIES)


def error_page() -> str:
    """Return Markdown that lists every error, by status and by name."""
    known = sorted(kinds(), key=lambda kind: (status(kind), kind.__name__))
    problem_kinds = [kind for kind in known if status(kind) != 500]
    inner = sorted((kind for kind in known if status(kind) == 500), key=lambda one: one.__name__)
    return page(
        "# Errors",
        "A service refuses a request with a problem document (RFC 9457). Its `type` names the "
        "kind of problem, `detail` says what happened, why, and what to do, and `instance` has "
        "the request's id, as in the service's log. The Python client raises the class of "
        "`sceneprint_client.errors` that the problem is named for.",
        "## Problems by status",
        table(("status", "`type`", "meaning", "what to do"), sorted(_problems(problem_kinds))),
        "## Other errors",
        "The client, the command line and the library raise these. If a service meets one, it "
        "answers with status 500.",
        table(
            ("class", "meaning", "what to do"),
            ((code(one.__name__), _meaning(one), cell(remedy(one))) for one in inner),
        ),
    )


def _problems(problem_kinds: list[type[SceneprintError]]) -> Iterator[tuple[str, str, str, str]]:
    for kind in problem_kinds:
        number = status(kind)
        yield _status(number), code(type_of(kind.__name__)), _meaning(kind), cell(remedy(kind))
    for number, name, meaning, what in OTHERS:
        yield _status(number), code(type_of(name)), cell(meaning), cell(what)


def _status(number: int) -> str:
    return f"{number} {phrase(number)}"


def _meaning(kind: type[SceneprintError]) -> str:
    return cell((inspect.getdoc(kind) or "").partition("\n\n")[0])
