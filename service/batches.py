"""Many frames in one form, each with its own metadata and its own answer.

form  --frames_of-->  Incoming  --read-->  Upload, ...  --told-->  Batch
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, BinaryIO

from fastapi import Request
from pydantic import ValidationError
from pydantic_core import from_json
from starlette.datastructures import UploadFile

from sceneprint.engine.replaying import Outcome, item_of
from sceneprint.engine.uploads import Upload
from sceneprint.errors import InvalidRequest, MalformedBody
from sceneprint.schemas import FrameMeta
from sceneprint.schemas.ingest import MOST_OF_BATCH, Batch
from sceneprint.schemas.novelty import novelty_of
from service.bodies import check_parts, form_of, priority_of, texts_of
from service.problems import invalid


@dataclass(frozen=True, eq=False)
class Incoming:
    """Frames that came in one form.

    Parameters
    ----------
    files : their bytes, not yet read
    metas : what is known of each, or why that cannot be
    priority, if_novel : of all
    """

    files: Sequence[BinaryIO]
    metas: Sequence[FrameMeta | InvalidRequest]
    priority: int
    if_novel: float | None

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
async def frames_of(request: Request) -> AsyncIterator[Incoming]:
    """Read a form with parts `frame` and a field `metas`.

    Raises
    ------
    UnsupportedType, MalformedBody, StoreFull, UnusableStore : see `form_of`.
    InvalidRequest : there is no frame, or there are not as many metadata as frames.
    """
    async with form_of(request, most_files=MOST_OF_BATCH) as form:
        check_parts(form, ("frame", "metas", "priority", "if_novel"))
        files = [one.file for one in form.getlist("frame") if isinstance(one, UploadFile)]
        if not files or len(files) != len(form.getlist("frame")):
            raise InvalidRequest(
                f"The form has no file part `frame`, or one that is no file. Send 1 to "
                f"{MOST_OF_BATCH} depth images or point clouds in parts of that name, each with a "
                "file name.",
                (("frame", "not files alone"),),
            )
        texts = texts_of(form)
        metas = _metas(texts.get("metas"), len(files))
        yield Incoming(files, metas, priority_of(texts), novelty_of(texts.get("if_novel")))


def told(batch: Incoming, outcomes: Sequence[Outcome]) -> Batch:
    """What came of each frame, in their order."""
    rest = iter(outcomes)
    return Batch(
        items=[
            item_of(next(rest) if isinstance(one, FrameMeta) else Outcome(None, error=one))
            for one in batch.metas
        ]
    )


def _metas(text: str | None, count: int) -> list[FrameMeta | InvalidRequest]:
    if text is None:
        raise InvalidRequest(
            "The form has no field `metas`. Send JSON in it: an object for all frames, or a list "
            "with one for each.",
            (("metas", "missing"),),
        )
    try:
        given = from_json(text)
    except ValueError as error:
        raise MalformedBody("The field `metas` is not JSON. Send an object or a list.") from error
    if isinstance(given, dict):
        return [_meta(given)] * count
    if not isinstance(given, list) or len(given) != count:
        told = f"a list of {len(given)}" if isinstance(given, list) else "neither object nor list"
        raise InvalidRequest(
            f"`metas` is {told}, and there are {count} frames. Send an object for all, or a list "
            "with one for each.",
            (("metas", "not one for each frame"),),
        )
    return [_meta(one) for one in given]


def _meta(given: Any) -> FrameMeta | InvalidRequest:
    try:
        return FrameMeta.model_validate(given)
    except ValidationError as error:
        return invalid(error, "What is known of the frame")
