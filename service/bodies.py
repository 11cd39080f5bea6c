"""Bodies of requests: forms with a frame, or JSON."""

from __future__ import annotations

import errno
import hashlib
import json
import re
import tempfile
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, Any, BinaryIO, TypeVar, cast, get_args

from fastapi import Header, Request, Response
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json
from python_multipart.multipart import parse_options_header
from starlette.datastructures import FormData, UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException

from sceneprint.engine.ingest.uploads import Upload, UploadResult, item_of
from sceneprint.errors import (
    InvalidRequest,
    MalformedBody,
    StoreFull,
    TooLarge,
    UnreadableFrame,
    UnsupportedType,
    UnusableStore,
)
from sceneprint.formats.depth_file import size_of
from sceneprint.store.keys import IdempotentRequest
from sceneprint_client.api import FrameMeta
from sceneprint_client.api.base import invalid_record, novelty_of, record_of
from sceneprint_client.api.frames import MOST_OF_BATCH, MOST_PRIORITY, Batch
from sceneprint_client.formats import (
    HEAD,
    CloudFormat,
    format_of,
    formats_of,
    media_types_of,
    titles_of,
)
from service.auth import Caller
from service.limits import IN_MEMORY

_Record = TypeVar("_Record", bound=BaseModel)

# A frame as the whole body of a request, and what is known of it in the query string.
#
# curl --data-binary @frame.png -H 'Content-Type: image/png' '...?fx=585&fy=585&cx=320&cy=240'
# curl --data-binary @scan.ply -H 'Content-Type: application/ply' '...?robot=spot'

#: Types of a body that is a frame; its first bytes decide which of them it is.
TYPES = media_types_of("depth", "cloud")

_CAMERA = ("fx", "fy", "cx", "cy", "width", "height", "distortion")
_PLAIN = (
    "depth_scale", "depth_along_ray", "trust_depth", "units_per_metre", "format", "robot",
    "session", "captured_at", "name", "sequence",
)  # fmt: skip
_OTHERS = ("viewpoint", "tags", "pose", "parent_frame", "base", "base_frame", "up")
_SEVEN = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def content(types: Sequence[str] = TYPES) -> dict[str, Any]:
    """Bodies of this kind, for `requestBody.content` of the OpenAPI document."""
    return {one: {"schema": {"type": "string", "format": "binary"}} for one in types}


def parameters() -> list[dict[str, Any]]:
    """What the query string may say of a frame that is the body, for the OpenAPI document."""
    number, text = {"type": "number"}, {"type": "string"}
    whole = {"type": "integer", "minimum": 1, "maximum": 65535}
    own = "Where the frame is the body: "
    told: dict[str, tuple[dict[str, Any], str]] = {
        "meta": (text, "FrameMeta as JSON, in place of what follows."),
        **dict.fromkeys(("fx", "fy", "cx", "cy"), (number, "of the camera, pixels.")),
        "width": (whole, "of the camera's image, pixels; default: that of the image."),
        "height": (whole, "as `width`."),
        "distortion": (text, "k1,k2,p1,p2[,k3] of OpenCV."),
        "depth_scale": (number, "stored units per metre; default: 1000."),
        "depth_along_ray": ({"type": "boolean"}, "samples are ranges along the pixel's ray."),
        "trust_depth": ({"type": "boolean"}, "take a depth image that does not look like one."),
        "viewpoint": (text, "of a point cloud: x,y,z in metres; `none` where there is none."),
        "units_per_metre": (number, "of a point cloud; default: 1."),
        "format": (
            {"type": "string", "enum": list(get_args(CloudFormat))},
            "of a point cloud: needed for `kitti` alone.",
        ),
        "robot": (text, "who took it."),
        "session": (text, "in which run."),
        "captured_at": ({"type": "string", "format": "date-time"}, "when, with its time zone."),
        "name": (text, "of the original file or message."),
        "sequence": ({"type": "integer", "minimum": 0}, "place within the session."),
        "tags": (text, "with commas between."),
        "pose": (text, f"T_parent_sensor as {','.join(_SEVEN)}: metres, unit quaternion."),
        "parent_frame": (text, "what `pose` leads to; default: ROBOT/SESSION."),
        "base": (text, "T_base_sensor, written as `pose`: where the sensor sits on the robot."),
        "base_frame": (text, "what the robot calls its base; default: base_link."),
        "up": (text, "up in the sensor's axes as x,y,z: a unit vector."),
    }
    return [query_parameter(name, schema, own + what) for name, (schema, what) in told.items()]


def query_parameter(name: str, schema: Mapping[str, Any], description: str) -> dict[str, Any]:
    """A parameter of the query string that may be left out, for the OpenAPI document."""
    return {
        "name": name, "in": "query", "required": False, "schema": schema,
        "description": description,
    }  # fmt: skip


async def received(
    request: Request, fields: Sequence[str]
) -> tuple[UploadFile, FrameMeta, dict[str, str]]:
    """Read a body that is a frame.

    Parameters
    ----------
    request : of one of `TYPES`
    fields : that the query string may have beside what is known of the frame

    Returns
    -------
    file : to be closed
    meta : what is known of it
    others : those of `fields` that were given

    Raises
    ------
    InvalidRequest : a parameter is missing, unknown, given twice or not as it should be.
    MalformedBody : `meta` is no JSON.
    StoreFull, UnusableStore : the machine cannot keep the body until it is read.
    """
    given = query_parameters(request, ("meta", *_CAMERA, *_PLAIN, *_OTHERS, *fields))
    spooled = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY)  # noqa: SIM115  (the caller's)
    file = UploadFile(cast(BinaryIO, spooled), size=0)
    try:
        try:
            async for chunk in request.stream():
                await file.write(chunk)
            await file.seek(0)
            head = await file.read(HEAD)
            await file.seek(0)
            if not head:
                raise UnreadableFrame(_NO_BODY)
        except OSError as error:
            raise unspoolable(error) from error
        others = {name: given.pop(name) for name in fields if name in given}
        meta = _query_meta(given, head)  # a query string is short
    except BaseException:
        await file.close()
        raise
    return file, meta, others


def unspoolable(error: OSError) -> UnusableStore:
    """That the machine cannot keep a body until it is read."""
    kind = StoreFull if error.errno in (errno.ENOSPC, errno.EDQUOT) else UnusableStore
    return kind(
        f"The upload cannot be written to the temporary folder ({error}). Free some space there, "
        "or set TMPDIR to another folder."
    )


def query_parameters(request: Request, known: Sequence[str]) -> dict[str, str]:
    """Return the query string of a request that is not a form; raise InvalidRequest for unknown or
    repeated parameters.
    """
    given: dict[str, str] = {}
    for name, value in request.query_params.multi_items():
        if name not in known:
            raise InvalidRequest(
                f"The query string has an unknown parameter {name!r:.80}. Known parameters are "
                f"{', '.join(sorted(known))}.",
                ((name[:80], "unknown"),),
            )
        if name in given:
            raise InvalidRequest(
                f"The query string has {name!r} twice. Send it once.", ((name, "given twice"),)
            )
        given[name] = value
    return given


def _query_meta(given: dict[str, str], head: bytes) -> FrameMeta:
    text = take_alone(given, "meta")
    if text is not None:
        return read_meta(text, "The parameter `meta`")
    return record_of(FrameMeta, _fields(given, head), "The frame metadata in the query string")


def take_alone(given: dict[str, str], name: str) -> str | None:
    """Take a parameter that stands for all others; InvalidRequest where it has some beside it."""
    text = given.pop(name, None)
    if text is not None and given:
        raise InvalidRequest(
            f"The query string has `{name}` and {', '.join(sorted(given))}. Put everything into "
            f"`{name}`, or leave it out.",
            tuple((other, f"beside {name}") for other in sorted(given)),
        )
    return text


def _fields(given: Mapping[str, str], head: bytes) -> dict[str, Any]:
    """Fields of FrameMeta from single parameters."""
    camera: dict[str, Any] = {name: given[name] for name in _CAMERA if name in given}
    if "distortion" in camera:
        camera["distortion"] = camera["distortion"].split(",")
    size = size_of(head)
    # an array of three or four columns is a cloud, unless somebody speaks of a camera
    is_image = bool(camera) or ("format" not in given and format_of(head) is None)
    if size is not None and is_image:
        camera = {"width": size[0], "height": size[1], **camera}
    found: dict[str, Any] = {"intrinsics": camera} if camera else {}
    if "viewpoint" in given:
        found["viewpoint"] = _viewpoint(given["viewpoint"])
    found |= {name: given[name] for name in _PLAIN if name in given}
    if given.get("tags"):
        found["tags"] = given["tags"].split(",")
    add_transform(found, given, "pose", "pose", "parent_frame")
    add_transform(found, given, "base", "T_base_sensor", "base_frame")
    add_up(found, given)
    return found


def add_up(found: dict[str, Any], given: Mapping[str, str]) -> None:
    """Add `up` where the query string has it; the record sees whether it is a direction."""
    if "up" in given:
        found["up"] = given["up"].split(",")


def add_transform(
    found: dict[str, Any], given: Mapping[str, str], name: str, field: str, frame: str
) -> None:
    """Add a transform that the query string has, and the frame that it leads to.

    Parameters
    ----------
    found : fields of a record
    given : the query string
    name, frame : of the two parameters

    Raises
    ------
    InvalidRequest : it has not seven numbers, or the frame is given alone.
    """
    if name in given:
        found[field] = _transform(name, given[name])
        if frame in given:
            found[field][frame] = given[frame]
    elif frame in given:
        raise InvalidRequest(
            f"The query string has `{frame}` but no `{name}`. Send both.",
            ((frame, f"without {name}"),),
        )


def _viewpoint(text: str) -> dict[str, Any] | str | None:
    if text in ("none", "file"):
        return None if text == "none" else text
    parts = text.split(",")
    if len(parts) != 3:
        raise InvalidRequest(
            f"`viewpoint` has {len(parts)} numbers. Send x,y,z in metres, comma-separated, or "
            "`none` if the cloud has no single viewpoint.",
            (("viewpoint", "not three numbers"),),
        )
    return dict(zip("xyz", parts, strict=True))


def _transform(name: str, text: str) -> dict[str, Any]:
    parts = text.split(",")
    if len(parts) != len(_SEVEN):
        raise InvalidRequest(
            f"`{name}` has {len(parts)} numbers. Send {','.join(_SEVEN)}: metres and a unit "
            "quaternion, comma-separated.",
            ((name, "not seven numbers"),),
        )
    return {
        "translation": dict(zip("xyz", parts[:3], strict=True)),
        "rotation": dict(zip("xyzw", parts[3:], strict=True)),
    }


#: Most bytes of a form field that is no file, and of a JSON body.
FIELD_BYTES = 1 << 18
FORM = "multipart/form-data"
#: Charsets a form may name: those whose text is UTF-8 as well.
_CHARSETS = ("utf-8", "utf8", "us-ascii", "ascii")

FRAME_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        FORM: {
            "schema": {
                "type": "object",
                "required": ["frame", "meta"],
                "properties": {
                    "frame": {
                        "type": "string",
                        "format": "binary",
                        "description": "A depth image: "
                        + ", ".join(f"{one.title} ({one.content})" for one in formats_of("depth"))
                        + f". Or a point cloud: {titles_of('cloud', last='or')}.",
                    },
                    "meta": {"$ref": "#/components/schemas/FrameMeta"},
                },
            },
            "encoding": {"meta": {"contentType": "application/json"}},
        }
    },
}


@dataclass(frozen=True, eq=False)
class FormUpload:
    """A frame that came in a form, or as the body.

    Parameters
    ----------
    file : its bytes, large ones on disk until they are read
    meta : what is known of it
    fields : what else the form or the query string says
    """

    file: BinaryIO
    meta: FrameMeta
    fields: dict[str, str]


_NO_BODY = (
    "The body is empty. Send the file itself: of curl, with --data-binary @FILE or -F frame=@FILE."
)


def _has_no_body(request: Request) -> bool:
    """Return whether the headers of a request say that nothing follows them."""
    headers = request.headers
    return headers.get("content-length", "0") == "0" and "transfer-encoding" not in headers


def media_type(request: Request) -> str:
    """Type of the body, without its parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def _charset(request: Request) -> str:
    """Charset that a form names, in lower case; UTF-8 where it names none."""
    _, parameters = parse_options_header(request.headers["content-type"])
    return parameters.get(b"charset", b"utf-8").decode("latin-1").lower()


@asynccontextmanager
async def uploaded(request: Request, *fields: str) -> AsyncIterator[FormUpload]:
    """Read a frame: a form with a file part `frame`, a field `meta`, and others that are named; or
    the frame alone, with the same in the query string.

    Parameters
    ----------
    request : with the body
    fields : names of the other fields that it may have

    Raises
    ------
    UnsupportedType : neither.
    MalformedBody : a form or JSON that cannot be parsed.
    InvalidRequest : a part is missing or unknown, or `meta` is not as it should be.
    StoreFull, UnusableStore : the machine cannot keep it until it is read.
    """
    if media_type(request) in TYPES:
        file, meta, others = await received(request, fields)
        try:
            yield FormUpload(file.file, meta, others)
        finally:
            await file.close()
        return
    async with form_of(request, most_files=1) as form:
        check_parts(form, {"frame", "meta", *fields})
        frame = form.get("frame")
        if not isinstance(frame, UploadFile) or len(form.getlist("frame")) != 1:
            raise InvalidRequest(
                "The form has no file part `frame`, or more than one part of that name. Send the "
                "depth image or point cloud in it, with a file name.",
                (("frame", "not one file"),),
            )
        texts = texts_of(form)
        yield FormUpload(frame.file, _meta(texts.pop("meta", None)), texts)


@asynccontextmanager
async def form_of(request: Request, most_files: int) -> AsyncIterator[FormData]:
    """Read a form; its files are closed afterwards. Errors as for `uploaded`."""
    if _has_no_body(request):
        raise MalformedBody(_NO_BODY)
    if media_type(request) != FORM:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send a frame as {FORM}: a "
            "file part `frame` and a field `meta` with JSON. You can also send a single frame "
            f"as the whole body, as {', '.join(TYPES)}."
        )
    # Python decodes some of the others in a time that grows with the square of their length, and
    # not every version of Python alike
    if (charset := _charset(request)) not in _CHARSETS:
        raise MalformedBody(
            f"The form's charset is {charset!r:.80}. Send the form in UTF-8, without `charset`."
        )
    try:
        form = await request.form(max_files=most_files, max_fields=16, max_part_size=FIELD_BYTES)
    except (HTTPException, MultiPartException) as error:
        raise MalformedBody(
            f"The form cannot be parsed ({getattr(error, 'detail', error)}). Send a file part "
            "`frame` and a field `meta`, with a boundary as in RFC 7578."
        ) from error
    except OSError as error:  # what is too large for memory is spooled to a file meanwhile
        raise unspoolable(error) from error
    try:
        yield form
    finally:
        await form.close()


def check_parts(form: FormData, known: Collection[str]) -> None:
    """See that a form has no part that would have no effect; InvalidRequest."""
    for name in form:
        if name not in known:
            raise InvalidRequest(
                f"The form has an unknown part {name!r:.80}. Known parts are "
                f"{', '.join(sorted(known))}.",
                ((name[:80], "unknown"),),
            )


def texts_of(form: FormData) -> dict[str, str]:
    """The parts of a form that are no files, each once; InvalidRequest."""
    return {name: _text(form.getlist(name), name) for name in form if name != "frame"}


def priority_of(fields: Mapping[str, str]) -> int:
    """Return the field `priority` of an upload, by default 0; raise InvalidRequest beyond
    MOST_PRIORITY.
    """
    text = fields.get("priority", "0")
    number = int(text) if re.fullmatch(r"[+-]?[0-9]{1,3}", text.strip(), re.ASCII) else None
    if number is None or abs(number) > MOST_PRIORITY:
        raise InvalidRequest(
            f"The priority is {text!r:.40}. Send a whole number from {-MOST_PRIORITY} to "
            f"{MOST_PRIORITY}, or leave it out for 0.",
            (("priority", "not a whole number in the allowed range"),),
        )
    return number


def json_body(record: str, *, required: bool = True) -> dict[str, Any]:
    """Return `openapi_extra` of an operation that reads a record as JSON by hand."""
    schema = {"$ref": f"#/components/schemas/{record}"}
    content = {"application/json": {"schema": schema}}
    return {"requestBody": {"required": required, "content": content}}


async def read_json(request: Request) -> Any:
    """Return the JSON body of a request. Raise MalformedBody if it is not JSON, and TooLarge,
    without reading on, if it is longer than any valid one.
    """
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > FIELD_BYTES:
            raise TooLarge(
                f"The JSON exceeds the limit of {FIELD_BYTES} bytes. Send only the fields in /docs."
            )
    if not body:
        raise MalformedBody("The body is empty. Send a JSON object.")
    try:
        return from_json(bytes(body))  # unlike `json`, no text that is not Unicode
    except ValueError as error:
        raise MalformedBody(f"The body is not JSON ({error}). Send a JSON object.") from error


async def read_json_object(
    request: Request, what: str, types: Sequence[str], otherwise: str = ""
) -> dict[str, Any]:
    """A JSON object that is sent as one of some types; errors as of `read_record`.

    FastAPI would read and parse all of it before it asks for a key.
    """
    if media_type(request) not in types:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send JSON as "
            f"{' or '.join(types)}{otherwise}."
        )
    document = await read_json(request)
    if not isinstance(document, dict):
        raise InvalidRequest(
            f"{what} is not a JSON object. See /docs for its fields.", (("", "not an object"),)
        )
    return document


async def read_record(
    request: Request, kind: type[_Record], what: str, *, optional: bool = False
) -> _Record:
    """A record that is sent as JSON.

    Parameters
    ----------
    request : with the body
    kind : of the record
    what : to begin an error with, such as "The association"
    optional : whether a request may come without a body: a record of defaults

    Raises
    ------
    UnsupportedType, MalformedBody, TooLarge : not JSON; see `read_json`.
    InvalidRequest : not such a record.
    """
    if optional and _has_no_body(request):
        return kind()
    types = ("application/json",)
    document = await read_json_object(request, what, types, ", or no body" if optional else "")
    return record_of(kind, document, what)


def read_meta(text: str, what: str) -> FrameMeta:
    """The metadata of a frame from JSON, or what is wrong with it."""
    try:
        return FrameMeta.model_validate_json(text)
    except ValidationError as error:
        if error.errors(include_url=False)[0]["type"] == "json_invalid":
            raise MalformedBody(f"{what} is not JSON. Send a JSON object.") from error
        raise invalid_record(error, what) from error


def _meta(text: str | None) -> FrameMeta:
    if text is None:
        raise InvalidRequest(
            "The form has no field `meta`. Send JSON in it: for a depth image at least the "
            "camera intrinsics, for a point cloud {}.",
            (("meta", "missing"),),
        )
    return read_meta(text, "The field `meta`")


def _text(values: list[UploadFile | str], name: str) -> str:
    if len(values) != 1 or not isinstance(values[0], str):
        raise InvalidRequest(
            f"The form has the part {name!r} more than once, or as a file. Send it once, as text.",
            ((name, "not one text"),),
        )
    return values[0]


# Many frames in one form, each with its own metadata and its own answer.
#
# form  --frames_of-->  FormFrames  --read-->  Upload, ...  --upload_responses-->  Batch


@dataclass(frozen=True, eq=False)
class FormFrames:
    """Frames that came in one form.

    Parameters
    ----------
    files : their bytes, not yet read
    metas : what is known of each, or why that cannot be
    texts : the other fields
    """

    files: Sequence[BinaryIO]
    metas: Sequence[FrameMeta | InvalidRequest]
    texts: Mapping[str, str]

    @property
    def priority(self) -> int:
        """Of all, in the queue."""
        return priority_of(self.texts)

    @property
    def if_novel(self) -> float | None:
        """Of all: kept only if new by so much."""
        return novelty_of(self.texts.get("if_novel"))

    def read(self) -> list[Upload]:
        """Those whose metadata are sound."""
        return [
            Upload(file.read(), meta, self.priority, self.if_novel)
            for file, meta in zip(self.files, self.metas, strict=True)
            if isinstance(meta, FrameMeta)
        ]

    def faults(self) -> list[str]:
        """What is wrong with the others."""
        return [f"{i} {one}" for i, one in enumerate(self.metas) if not isinstance(one, FrameMeta)]


@asynccontextmanager
async def frames_of(
    request: Request, *fields: str, most: int = MOST_OF_BATCH
) -> AsyncIterator[FormFrames]:
    """Read a form with parts `frame` and a field `metas`.

    Parameters
    ----------
    request : with the form
    fields : names of the other fields that it may have
    most : frames that it may have

    Raises
    ------
    UnsupportedType, MalformedBody, StoreFull, UnusableStore : see `form_of`.
    InvalidRequest : there is no frame, or there are not as many metadata as frames.
    """
    async with form_of(request, most_files=most) as form:
        check_parts(form, ("frame", "metas", *fields))
        files = [one.file for one in form.getlist("frame") if isinstance(one, UploadFile)]
        if not files or len(files) != len(form.getlist("frame")):
            raise InvalidRequest(
                "The form has no file part `frame`, or one that is not a file. Send 1 to "
                f"{most} depth images or point clouds in parts of that name, each with "
                "a file name.",
                (("frame", "not all files"),),
            )
        texts = dict(texts_of(form))
        metas = _metas(texts.pop("metas", None), len(files))
        batch = FormFrames(files, metas, texts)
        _ = batch.priority, batch.if_novel  # what is wrong with them is said before anything else
        yield batch


def upload_responses(batch: FormFrames, outcomes: Sequence[UploadResult]) -> Batch:
    """What came of each frame, in their order."""
    rest = iter(outcomes)
    return Batch(
        items=[
            item_of(next(rest) if isinstance(one, FrameMeta) else UploadResult(None, error=one))
            for one in batch.metas
        ]
    )


def _metas(text: str | None, count: int) -> list[FrameMeta | InvalidRequest]:
    if text is None:
        raise InvalidRequest(
            "The form has no field `metas`. Send JSON in it: one object for all frames, or a "
            "list with one for each.",
            (("metas", "missing"),),
        )
    try:
        given = from_json(text)
    except ValueError as error:
        raise MalformedBody("The field `metas` is not JSON. Send an object or a list.") from error
    if isinstance(given, dict):
        return [_batch_meta(given)] * count
    if not isinstance(given, list) or len(given) != count:
        told = f"a list of {len(given)}" if isinstance(given, list) else "neither object nor list"
        raise InvalidRequest(
            f"`metas` is {told}, but there are {count} frames. Send one object for all, or a "
            "list with one for each.",
            (("metas", "not one for each frame"),),
        )
    return [_batch_meta(one) for one in given]


def _batch_meta(given: Any) -> FrameMeta | InvalidRequest:
    try:
        return FrameMeta.model_validate(given)
    except ValidationError as error:
        return invalid_record(error, "The frame metadata")


# The header Idempotency-Key: a request that is sent again takes effect once.
#
# guarded(asking, key, route, payload...)  -->  Once, which the engine stores with what it made

#: As a parameter of a route: `key: IdempotencyKey = None`.
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=255,
        pattern=r"^[\x20-\x7e]+$",
        description="Made up by the caller for this request, printable ASCII. The same request "
        "sent again with it within a day takes effect once, and is answered as things are now, "
        "with `Idempotent-Replayed: true`; another request with it is refused.",
    ),
]


def guarded(asking: Caller, key: str | None, *parts: object) -> IdempotentRequest | None:
    """What makes a request take effect once; None where the caller asks for no such thing.

    Parameters
    ----------
    asking : who asks: keys of two callers have nothing to do with each other
    parts : of the request, all that makes it another one: route, map, content, metadata; bytes,
        records, or what JSON can say
    """
    if key is None:
        return None
    plain = json.dumps([_plain(part) for part in parts], sort_keys=True)
    return IdempotentRequest(asking.name, key, hashlib.sha256(plain.encode()).hexdigest())


def mark_replayed(response: Response, *, replayed: bool) -> None:
    """Say that an answer is that of an earlier request."""
    if replayed:
        response.headers["Idempotent-Replayed"] = "true"


def _plain(part: object) -> object:
    if isinstance(part, bytes):
        return hashlib.sha256(part).hexdigest()
    if isinstance(part, BaseModel):
        # a field that a later version adds leaves the fingerprint of a request without it as it is
        return part.model_dump(mode="json", exclude_defaults=True)
    if isinstance(part, list | tuple):
        return [_plain(one) for one in part]
    return part
