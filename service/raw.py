"""A frame as the whole body of a request, and what is known of it in the query string.

curl --data-binary @frame.png -H 'Content-Type: image/png' '...?fx=585&fy=585&cx=320&cy=240'
curl --data-binary @scan.ply -H 'Content-Type: application/ply' '...?robot=spot'
"""

from __future__ import annotations

import errno
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO, cast, get_args

from fastapi import Request
from pydantic import ValidationError
from starlette.datastructures import UploadFile

from sceneprint.datasets.sizes import HEAD, size_of
from sceneprint.errors import InvalidRequest, MalformedBody, StoreFull, UnusableStore
from sceneprint.scans import format_of
from sceneprint.schemas import FrameMeta
from sceneprint.schemas.frames import CloudFormat
from service.problems import invalid

#: Types of a body that is a frame; its first bytes decide which of them it is.
TYPES = ("image/png", "application/x-npy", "application/ply", "application/octet-stream")
#: Bytes of a body that are kept in memory until they are read; the rest waits on disk.
_IN_MEMORY = 1 << 20

_CAMERA = ("fx", "fy", "cx", "cy", "width", "height", "distortion")
_PLAIN = (
    "depth_scale", "depth_along_ray", "units_per_metre", "format", "robot", "session",
    "captured_at",
)  # fmt: skip
_OTHERS = ("viewpoint", "tags", "pose", "parent_frame", "base", "base_frame")
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
        "viewpoint": (text, "of a point cloud: x,y,z in metres; `none` where there is none."),
        "units_per_metre": (number, "of a point cloud; default: 1."),
        "format": (
            {"type": "string", "enum": list(get_args(CloudFormat))},
            "of a point cloud: needed for `kitti` alone.",
        ),
        "robot": (text, "who took it."),
        "session": (text, "in which run."),
        "captured_at": ({"type": "string", "format": "date-time"}, "when, with its time zone."),
        "tags": (text, "with commas between."),
        "pose": (text, f"T_parent_sensor as {','.join(_SEVEN)}: metres, unit quaternion."),
        "parent_frame": (text, "what `pose` leads to; default: ROBOT/SESSION."),
        "base": (text, "T_base_sensor, written as `pose`: where the sensor sits on the robot."),
        "base_frame": (text, "what the robot calls its base; default: base_link."),
    }
    return [
        {
            "name": name,
            "in": "query",
            "required": False,
            "schema": schema,
            "description": own + what,
        }
        for name, (schema, what) in told.items()
    ]


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
    given = once_each(request, ("meta", *_CAMERA, *_PLAIN, *_OTHERS, *fields))
    spooled = tempfile.SpooledTemporaryFile(max_size=_IN_MEMORY)  # noqa: SIM115  (the caller's)
    file = UploadFile(cast(BinaryIO, spooled), size=0)
    try:
        try:
            async for chunk in request.stream():
                await file.write(chunk)
            await file.seek(0)
            head = await file.read(HEAD)
            await file.seek(0)
        except OSError as error:
            raise unspoolable(error) from error
        others = {name: given.pop(name) for name in fields if name in given}
        meta = _meta(given, head)  # a query string is short
    except BaseException:
        await file.close()
        raise
    return file, meta, others


def unspoolable(error: OSError) -> UnusableStore:
    """That the machine cannot keep a body until it is read."""
    kind = StoreFull if error.errno in (errno.ENOSPC, errno.EDQUOT) else UnusableStore
    return kind(
        f"An upload cannot be kept in the folder of temporary files ({error}). Make room "
        "there, or name another folder in TMPDIR."
    )


def once_each(request: Request, known: Sequence[str]) -> dict[str, str]:
    """The query string of a request that is not a form.

    Raises
    ------
    InvalidRequest : it has something twice, or that is not known.
    """
    given: dict[str, str] = {}
    for name, value in request.query_params.multi_items():
        if name not in known:
            raise InvalidRequest(
                f"The query string has {name!r:.80}, which is not known. It may "
                f"have {', '.join(sorted(known))}.",
                ((name[:80], "not known"),),
            )
        if name in given:
            raise InvalidRequest(
                f"The query string has {name!r} twice. Send it once.", ((name, "given twice"),)
            )
        given[name] = value
    return given


def _meta(given: dict[str, str], head: bytes) -> FrameMeta:
    text = given.pop("meta", None)
    if text is not None and given:
        raise InvalidRequest(
            f"The query string has `meta` and {', '.join(sorted(given))}. Say all in `meta`, or "
            "leave it out.",
            tuple((name, "beside meta") for name in sorted(given)),
        )
    try:
        if text is not None:
            return FrameMeta.model_validate_json(text)
        return FrameMeta.model_validate(_fields(given, head))
    except ValidationError as error:
        if error.errors(include_url=False)[0]["type"] == "json_invalid":
            raise MalformedBody("The parameter `meta` is not JSON. Send a JSON object.") from error
        raise invalid(error, "What the query string says of the frame") from error


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
    return found


def add_transform(
    found: dict[str, Any], given: Mapping[str, str], name: str, field: str, frame: str
) -> None:
    """Add a transform that the query string has, and the frame that it leads to.

    Parameters
    ----------
    found : fields of a record
    given : the query string
    name, frame : of the two parameters
    field : of the record

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
            f"The query string has `{frame}`, and no `{name}`. Send both.",
            ((frame, f"without {name}"),),
        )


def _viewpoint(text: str) -> dict[str, Any] | str | None:
    if text in ("none", "file"):
        return None if text == "none" else text
    parts = text.split(",")
    if len(parts) != 3:
        raise InvalidRequest(
            f"`viewpoint` has {len(parts)} numbers. Send x,y,z in metres with commas between, or "
            "`none` where the cloud was seen from no single place.",
            (("viewpoint", "not three numbers"),),
        )
    return dict(zip("xyz", parts, strict=True))


def _transform(name: str, text: str) -> dict[str, Any]:
    parts = text.split(",")
    if len(parts) != len(_SEVEN):
        raise InvalidRequest(
            f"`{name}` has {len(parts)} numbers. Send {','.join(_SEVEN)}: metres and a unit "
            "quaternion, with commas between.",
            ((name, "not seven numbers"),),
        )
    return {
        "translation": dict(zip("xyz", parts[:3], strict=True)),
        "rotation": dict(zip("xyzw", parts[3:], strict=True)),
    }
