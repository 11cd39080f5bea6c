"""Parsers of request bodies: forms with frames, single frames and JSON."""

from __future__ import annotations

import errno
import hashlib
import json
import re
import tempfile
from collections.abc import AsyncIterator, Collection, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, Any, BinaryIO, TypeVar, cast

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
from sceneprint_client.api.base import CameraIntrinsics, invalid_record, novelty_of, record_of
from sceneprint_client.api.frames import MOST_OF_BATCH, MOST_PRIORITY, Batch
from sceneprint_client.formats import HEAD, format_of, formats_of, media_types_of, titles_of
from service.auth import Caller
from service.limits import IN_MEMORY

_Record = TypeVar("_Record", bound=BaseModel)

# Requests whose body is a frame, with its metadata in the query string.
#
# curl --data-binary @frame.png -H 'Content-Type: image/png' '...?fx=585&fy=585&cx=320&cy=240'
# curl --data-binary @scan.ply -H 'Content-Type: application/ply' '...?robot=spot'

FORM, JSON = "multipart/form-data", "application/json"
FILE: dict[str, Any] = {"type": "string", "format": "binary"}
META: dict[str, Any] = {"$ref": "#/components/schemas/FrameMeta"}
#: Media types of frames. The magic bytes of the body determine the format.
TYPES = media_types_of("depth", "cloud")

_CAMERA = ("fx", "fy", "cx", "cy", "width", "height", "distortion")
_PLAIN = (
    "depth_scale", "depth_along_ray", "trust_depth", "units_per_metre", "format", "robot",
    "session", "captured_at", "name", "sequence",
)  # fmt: skip
_OTHERS = ("viewpoint", "tags", "pose", "parent_frame", "base", "base_frame", "up")
#: Suffix of the descriptions of query parameters that replace form fields.
BARE = "Allowed only if the request body is the frame itself."
_SEVEN = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def content(types: Sequence[str] = TYPES) -> dict[str, Any]:
    """Return `requestBody.content` of these media types for the OpenAPI document."""
    return {kind: {"schema": FILE} for kind in types}


def parameters() -> list[dict[str, Any]]:
    """Return the query parameters of a frame sent as the body, for the OpenAPI document."""
    seven, size = ",".join(_SEVEN), "of the camera's image, pixels; default: that of the upload."
    own = CameraIntrinsics.model_json_schema()["properties"]
    own |= {"meta": {}, **FrameMeta.model_json_schema()["properties"]}
    texts = {
        "meta": "FrameMeta as JSON, instead of the parameters below.",
        **dict.fromkeys(("fx", "fy", "cx", "cy"), "Camera intrinsics, pixels."),
        "width": f"Width {size}",
        "height": f"Height {size}",
        "distortion": "OpenCV distortion coefficients k1,k2,p1,p2[,k3[,k4,k5,k6]].",
        **{name: own[name]["description"] for name in _PLAIN},
        "viewpoint": "Viewpoint of a point cloud as x,y,z in metres, or `none` if it has no single "
        "viewpoint.",
        "tags": "Tags, separated by commas.",
        "pose": f"T_parent_sensor as {seven}, in metres with a unit quaternion.",
        "parent_frame": "Parent frame of `pose`; default: ROBOT/SESSION.",
        "base": "T_base_sensor, the mounting pose of the sensor, in the format of `pose`.",
        "base_frame": "Name of the robot's base frame; default: base_link.",
        "up": "Unit vector x,y,z that points up, in the axes of the sensor.",
    }
    plain = (*_CAMERA[:6], *_PLAIN)
    return [
        option_parameter(name, {**own[name], "description": text} if name in plain
                         else {"type": "string", "description": text})
        for name, text in texts.items()
    ]  # fmt: skip


def option_parameter(name: str, option: Mapping[str, Any]) -> dict[str, Any]:
    """Return the query parameter of an option, for requests whose body is the frame."""
    schema = as_text(option)
    text = schema.pop("description", "The same as the field in JSON.")
    schema.pop("title", None)
    return query_parameter(name, schema, f"{text} {BARE}")


def as_text(option: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of an option in a form: objects as JSON text, lists separated by commas."""
    kinds = option.get("anyOf", [])
    reference = next((kind for kind in kinds if "$ref" in kind), None)
    texts = {name: option[name] for name in ("description", "title") if name in option}
    if reference is not None:
        content = {"contentMediaType": JSON, "contentSchema": reference}
        return {"type": "string", **content, **texts}
    if any(kind.get("type") == "array" for kind in kinds):
        values = option.get("default")
        default = {} if values is None else {"default": ",".join(values)}
        return {"type": "string", **default, **texts}
    plain = next((kind for kind in kinds if kind.get("type") != "null"), None)
    return dict(option) if plain is None else {**plain, **texts}


def form_body(
    properties: Mapping[str, Any], required: Sequence[str], *metas: str
) -> dict[str, Any]:
    """Return `requestBody` of a form, for the OpenAPI document; `metas` names its JSON parts."""
    schema = {"type": "object", "required": [*required], "properties": {**properties}}
    encoding = {name: {"contentType": JSON} for name in metas}
    return {"required": True, "content": {FORM: {"schema": schema, "encoding": encoding}}}


def query_parameter(name: str, schema: Mapping[str, Any], description: str) -> dict[str, Any]:
    """Return an optional query parameter, for the OpenAPI document."""
    return {
        "name": name, "in": "query", "required": False, "schema": schema,
        "description": description,
    }  # fmt: skip


async def read_frame_body(
    request: Request, fields: Sequence[str]
) -> tuple[UploadFile, FrameMeta, dict[str, str]]:
    """Read a request whose body is the frame; see `read_upload` for errors.

    Parameters
    ----------
    request : request with a media type of `TYPES`
    fields : names of allowed query parameters, besides the metadata

    Returns
    -------
    file : spooled body, to be closed by the caller
    meta : metadata of the frame
    others : parameters of `fields` that are present
    """
    values = query_parameters(request, ("meta", *_CAMERA, *_PLAIN, *_OTHERS, *fields))
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
            raise spool_error(error) from error
        others = {name: values.pop(name) for name in fields if name in values}
        text = take_alone(values, "meta")
        if text is not None:
            meta = read_meta(text, "The parameter `meta`")
        else:
            what = "The frame metadata in the query string"
            meta = record_of(FrameMeta, _fields(values, head), what)
    except BaseException:
        await file.close()
        raise
    return file, meta, others


def spool_error(error: OSError) -> UnusableStore:
    """Return the error for a body that cannot be written to the temporary folder."""
    kind = StoreFull if error.errno in (errno.ENOSPC, errno.EDQUOT) else UnusableStore
    return kind(
        f"The upload cannot be written to the temporary folder ({error}). Free some space there, "
        "or set TMPDIR to another folder."
    )


def query_parameters(request: Request, names: Sequence[str]) -> dict[str, str]:
    """Return the query parameters of a request; raise InvalidRequest for unknown or repeated
    parameters.
    """
    values: dict[str, str] = {}
    for name, value in request.query_params.multi_items():
        if name not in names:
            raise InvalidRequest(
                f"The query string has an unknown parameter {name!r:.80}. Known parameters are "
                f"{', '.join(sorted(names))}.",
                ((name[:80], "unknown"),),
            )
        if name in values:
            raise InvalidRequest(
                f"The query string has {name!r} twice. Send it once.", ((name, "repeated"),)
            )
        values[name] = value
    return values


def take_alone(values: dict[str, str], name: str) -> str | None:
    """Remove and return a parameter that must be alone; raise InvalidRequest if others are set."""
    text = values.pop(name, None)
    if text is not None and values:
        raise InvalidRequest(
            f"The query string has `{name}` and {', '.join(sorted(values))}. Put all fields into "
            f"`{name}`, or omit `{name}`.",
            tuple((other, f"conflicts with {name}") for other in sorted(values)),
        )
    return text


def _fields(values: Mapping[str, str], head: bytes) -> dict[str, Any]:
    """Convert query parameters to fields of FrameMeta; `head` is the beginning of the body."""
    camera: dict[str, Any] = {name: values[name] for name in _CAMERA if name in values}
    if "distortion" in camera:
        camera["distortion"] = camera["distortion"].split(",")
    size = size_of(head)
    # An array with three or four columns is a cloud, unless the request has camera parameters.
    is_image = bool(camera) or ("format" not in values and format_of(head) is None)
    if size is not None and is_image:
        camera = {"width": size[0], "height": size[1], **camera}
    fields: dict[str, Any] = {"intrinsics": camera} if camera else {}
    if "viewpoint" in values:
        fields["viewpoint"] = _viewpoint(values["viewpoint"])
    fields |= {name: values[name] for name in _PLAIN if name in values}
    if values.get("tags"):
        fields["tags"] = values["tags"].split(",")
    add_transform(fields, values, "pose", "pose", "parent_frame")
    add_transform(fields, values, "base", "T_base_sensor", "base_frame")
    add_up(fields, values)
    return fields


def add_up(fields: dict[str, Any], values: Mapping[str, str]) -> None:
    """Add the query parameter `up`, if present, to the fields of a record."""
    if "up" in values:
        fields["up"] = values["up"].split(",")


def add_transform(
    fields: dict[str, Any], values: Mapping[str, str], name: str, field: str, frame: str
) -> None:
    """Add a transform in the query string, if present, to the fields of a record.

    Parameters
    ----------
    fields : fields of a record, to which the transform is added
    values : parameters of the query string
    name, frame : names of the query parameters for the transform and for its parent frame
    field : name of the field of the transform

    Raises
    ------
    InvalidRequest : If the transform does not have seven numbers, or only its frame is present.
    """
    if name in values:
        fields[field] = _transform(name, values[name])
        if frame in values:
            fields[field][frame] = values[frame]
    elif frame in values:
        raise InvalidRequest(
            f"The query string has `{frame}` but no `{name}`. Send both.",
            ((frame, f"without {name}"),),
        )


def _viewpoint(text: str) -> dict[str, Any] | str | None:
    if text in ("none", "file"):
        return None if text == "none" else text
    what = "x,y,z in metres, or `none` if the cloud has no single viewpoint"
    return dict(zip("xyz", _numbers("viewpoint", text, 3, what), strict=True))


def _transform(name: str, text: str) -> dict[str, Any]:
    parts = _numbers(name, text, 7, f"{','.join(_SEVEN)}: metres and a unit quaternion")
    return {
        "translation": dict(zip("xyz", parts[:3], strict=True)),
        "rotation": dict(zip("xyzw", parts[3:], strict=True)),
    }


def _numbers(name: str, text: str, count: int, what: str) -> list[str]:
    """Split a parameter at commas; raise InvalidRequest unless it has `count` parts."""
    parts = text.split(",")
    if len(parts) != count:
        raise InvalidRequest(
            f"`{name}` has {len(parts)} numbers. Send {what}, comma-separated.",
            ((name, f"not {count} numbers"),),
        )
    return parts


#: Maximum size of a form field other than a file, and of a JSON body, bytes.
FIELD_BYTES = 1 << 18
#: Charsets that a form may declare; text in them is also valid UTF-8.
_CHARSETS = ("utf-8", "utf8", "us-ascii", "ascii")

_FORMATS = ", ".join(f"{form.title} ({form.content})" for form in formats_of("depth"))
_FRAME = f"A depth image as {_FORMATS}. Or a point cloud as {titles_of('cloud', last='or')}."
FRAME_PARTS: dict[str, Any] = {"frame": {**FILE, "description": _FRAME}, "meta": META}


@dataclass(frozen=True, eq=False)
class FormUpload:
    """A frame that was sent in a form or as a body.

    Parameters
    ----------
    file : content of the frame, on disk if it is large
    meta : metadata of the frame
    fields : other fields of the form or the query string
    """

    file: BinaryIO
    meta: FrameMeta
    fields: dict[str, str]


_NO_BODY = (
    "The body is empty. Send the file itself, for example with curl and --data-binary @FILE or "
    "-F frame=@FILE."
)


def _has_no_body(request: Request) -> bool:
    """Return whether a request has no body, according to its headers."""
    headers = request.headers
    return headers.get("content-length", "0") == "0" and "transfer-encoding" not in headers


def media_type(request: Request) -> str:
    """Return the media type of the body without its parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


@asynccontextmanager
async def read_upload(request: Request, *fields: str) -> AsyncIterator[FormUpload]:
    """Read a frame from a form with a file part `frame`, a field `meta` and other fields, or from a
    body that is the frame, with the same fields in the query string.

    Parameters
    ----------
    fields : names of other fields that the request may have

    Raises
    ------
    UnsupportedType : If the body is neither a form nor a frame.
    MalformedBody : If the form or its JSON cannot be parsed.
    InvalidRequest : If a part is missing or unknown, or `meta` is invalid.
    StoreFull, UnusableStore : If the frame cannot be written to the temporary folder.
    """
    if media_type(request) in TYPES:
        file, meta, others = await read_frame_body(request, fields)
        try:
            yield FormUpload(file.file, meta, others)
        finally:
            await file.close()
        return
    async with read_form(request, most_files=1) as form:
        check_parts(form, {"frame", "meta", *fields})
        frame = form.get("frame")
        if not isinstance(frame, UploadFile) or len(form.getlist("frame")) != 1:
            raise InvalidRequest(
                "The form has no file part `frame`, or more than one part of that name. Send the "
                "depth image or point cloud in one such part, with a file name.",
                (("frame", "not one file"),),
            )
        texts = texts_of(form)
        yield FormUpload(frame.file, _meta(texts.pop("meta", None)), texts)


@asynccontextmanager
async def read_form(request: Request, most_files: int) -> AsyncIterator[FormData]:
    """Read a form, and close its files at the end; see `read_upload` for errors."""
    if _has_no_body(request):
        raise MalformedBody(_NO_BODY)
    if media_type(request) != FORM:
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send a frame as {FORM}: a "
            "file part `frame` and a field `meta` with JSON. You can also send a single frame as "
            f"the whole body, with one of the types {', '.join(TYPES)}."
        )
    # Accept only these charsets: some versions of Python decode others in quadratic time.
    _, parameters = parse_options_header(request.headers["content-type"])
    charset = parameters.get(b"charset", b"utf-8").decode("latin-1").lower()
    if charset not in _CHARSETS:
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
    except OSError as error:
        raise spool_error(error) from error
    try:
        yield form
    finally:
        await form.close()


def check_parts(form: FormData, names: Collection[str]) -> None:
    """Raise InvalidRequest if a form has an unknown part."""
    for name in form:
        if name not in names:
            raise InvalidRequest(
                f"The form has an unknown part {name!r:.80}. Known parts are "
                f"{', '.join(sorted(names))}.",
                ((name[:80], "unknown"),),
            )


def texts_of(form: FormData) -> dict[str, str]:
    """Return the text parts of a form; raise InvalidRequest for a repeated part."""
    return {name: _text(form.getlist(name), name) for name in form if name != "frame"}


def priority_of(fields: Mapping[str, str]) -> int:
    """Return the field `priority` of an upload, by default 0; raise InvalidRequest if it is not
    valid.
    """
    text = fields.get("priority", "0")
    number = int(text) if re.fullmatch(r"[+-]?[0-9]{1,3}", text.strip(), re.ASCII) else None
    if number is None or abs(number) > MOST_PRIORITY:
        raise InvalidRequest(
            f"The priority is {text!r:.40}. Send a whole number from {-MOST_PRIORITY} to "
            f"{MOST_PRIORITY}, or omit it for the default of 0.",
            (("priority", "not a whole number in the allowed range"),),
        )
    return number


def json_body(record: str, *, required: bool = True) -> dict[str, Any]:
    """Return `openapi_extra` of an operation that parses a JSON record itself."""
    schema = {"$ref": f"#/components/schemas/{record}"}
    content = {JSON: {"schema": schema}}
    return {"requestBody": {"required": required, "content": content}}


async def read_json(request: Request) -> Any:
    """Return the JSON body of a request. Raise MalformedBody if it is not JSON, and TooLarge as
    soon as it exceeds FIELD_BYTES.
    """
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > FIELD_BYTES:
            raise TooLarge(
                f"The JSON exceeds the limit of {FIELD_BYTES} bytes. Send only the fields that "
                "/docs lists."
            )
    if not body:
        raise MalformedBody("The body is empty. Send a JSON object.")
    try:
        return from_json(bytes(body))  # unlike `json`, it refuses lone surrogates
    except ValueError as error:
        raise MalformedBody(f"The body is not JSON ({error}). Send a JSON object.") from error


async def read_json_object(
    request: Request, what: str, types: Sequence[str], otherwise: str = ""
) -> dict[str, Any]:
    """Return a JSON object sent with a media type in `types`; see `read_record` for errors. FastAPI
    would parse the body before it checks the key.
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
    """Return a record sent as JSON.

    Parameters
    ----------
    kind : class of the record
    what : prefix of error messages, such as "The association"
    optional : whether a missing body selects the default record

    Raises
    ------
    UnsupportedType, MalformedBody, TooLarge : If the body is not valid JSON; see `read_json`.
    InvalidRequest : If the JSON is not a valid record.
    """
    if optional and _has_no_body(request):
        return kind()
    otherwise = ", or no body" if optional else ""
    document = await read_json_object(request, what, (JSON,), otherwise)
    return record_of(kind, document, what)


def read_meta(text: str, what: str) -> FrameMeta:
    """Parse the metadata of a frame from JSON; `what` is the prefix of error messages."""
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


# Several frames in one form, each with its own metadata and its own result.
#
# form  --read_frames-->  FormFrames  --read-->  Upload, ...  --upload_responses-->  Batch


@dataclass(frozen=True, eq=False)
class FormFrames:
    """Frames of one form.

    Parameters
    ----------
    files : contents of the frames
    metas : metadata of each frame, or the error in its metadata
    texts : other fields of the form
    """

    files: Sequence[BinaryIO]
    metas: Sequence[FrameMeta | InvalidRequest]
    texts: Mapping[str, str]

    @property
    def priority(self) -> int:
        """Priority of all frames; raise InvalidRequest if it is not valid."""
        return priority_of(self.texts)

    @property
    def if_novel(self) -> float | None:
        """Minimum novelty of all frames; None accepts all frames."""
        return novelty_of(self.texts.get("if_novel"))

    def read(self) -> list[Upload]:
        """Return the uploads with valid metadata."""
        return [
            Upload(file.read(), meta, self.priority, self.if_novel)
            for file, meta in zip(self.files, self.metas, strict=True)
            if isinstance(meta, FrameMeta)
        ]

    def faults(self) -> list[str]:
        """Return the index and the error, as text, of each frame with invalid metadata."""
        return [
            f"{i} {meta}" for i, meta in enumerate(self.metas) if not isinstance(meta, FrameMeta)
        ]


@asynccontextmanager
async def read_frames(
    request: Request, *fields: str, most: int = MOST_OF_BATCH
) -> AsyncIterator[FormFrames]:
    """Read a form with parts `frame` and a field `metas`.

    Parameters
    ----------
    fields : names of other fields that the form may have
    most : maximum number of frames

    Raises
    ------
    UnsupportedType, MalformedBody, StoreFull, UnusableStore : See `read_form`.
    InvalidRequest : If there is no frame, or the number of metadata objects is wrong.
    """
    async with read_form(request, most_files=most) as form:
        check_parts(form, ("frame", "metas", *fields))
        files = [file.file for file in form.getlist("frame") if isinstance(file, UploadFile)]
        if not files or len(files) != len(form.getlist("frame")):
            raise InvalidRequest(
                "The form has no file part `frame`, or a part of that name that is not a file. "
                f"Send 1 to {most} depth images or point clouds in parts of that name, each with a "
                "file name.",
                (("frame", "not all files"),),
            )
        texts = dict(texts_of(form))
        metas = _metas(texts.pop("metas", None), len(files))
        batch = FormFrames(files, metas, texts)
        _ = batch.priority, batch.if_novel  # validate them early
        yield batch


def upload_responses(batch: FormFrames, outcomes: Sequence[UploadResult]) -> Batch:
    """Return the result of each frame in the order of the form."""
    rest = iter(outcomes)
    return Batch(
        items=[
            item_of(next(rest) if isinstance(meta, FrameMeta) else UploadResult(None, error=meta))
            for meta in batch.metas
        ]
    )


def _metas(text: str | None, count: int) -> list[FrameMeta | InvalidRequest]:
    if text is None:
        raise InvalidRequest(
            "The form has no field `metas`. Send JSON in it: one object for all frames, or a "
            "list with one object for each frame.",
            (("metas", "missing"),),
        )
    try:
        metas = from_json(text)
    except ValueError as error:
        raise MalformedBody(
            "The field `metas` is not JSON. Send one object, or a list of objects."
        ) from error
    if isinstance(metas, dict):
        return [_batch_meta(metas)] * count
    if not isinstance(metas, list) or len(metas) != count:
        kind = f"a list of {len(metas)}" if isinstance(metas, list) else "neither object nor list"
        raise InvalidRequest(
            f"`metas` is {kind}, but there are {count} frames. Send one object for all, or a "
            "list with one object for each frame.",
            (("metas", "not one for each frame"),),
        )
    return [_batch_meta(meta) for meta in metas]


def _batch_meta(meta: Any) -> FrameMeta | InvalidRequest:
    try:
        return FrameMeta.model_validate(meta)
    except ValidationError as error:
        return invalid_record(error, "The frame metadata")


# The header Idempotency-Key: a repeated request takes effect only once.
#
# idempotent_request(caller, key, route, payload...)  -->  IdempotentRequest, stored with the result

#: As a parameter of a route: `key: IdempotencyKey = None`.
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=255,
        pattern=r"^[\x20-\x7e]+$",
        description="Random key of this request, printable ASCII. If you repeat the request with "
        "the same key within a day, it takes effect only once; the response then shows the current "
        "state, with `Idempotent-Replayed: true`. A different request with the same key is "
        "refused.",
    ),
]


def idempotent_request(caller: Caller, key: str | None, *parts: object) -> IdempotentRequest | None:
    """Return the idempotent request of an idempotency key; None if there is no key.

    Parameters
    ----------
    caller : caller of the request; idempotency keys of different callers are independent
    parts : everything that identifies the request, such as route, map, content and metadata, as
        bytes, records or JSON values
    """
    if key is None:
        return None
    plain = json.dumps([_plain(part) for part in parts], sort_keys=True)
    return IdempotentRequest(caller.name, key, hashlib.sha256(plain.encode()).hexdigest())


def mark_replayed(response: Response, *, replayed: bool) -> None:
    """Add the header that marks the response to a repeated request."""
    if replayed:
        response.headers["Idempotent-Replayed"] = "true"


def _plain(part: object) -> object:
    if isinstance(part, bytes):
        return hashlib.sha256(part).hexdigest()
    if isinstance(part, BaseModel):
        # Exclude defaults, so that a new field in a later version does not change the fingerprint.
        return part.model_dump(mode="json", exclude_defaults=True)
    if isinstance(part, list | tuple):
        return [_plain(value) for value in part]
    return part
