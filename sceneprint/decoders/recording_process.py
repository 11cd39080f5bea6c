"""Program of a process that reads a ROS recording.

    python -m sceneprint.decoders.recording_process CONTROL PARENT BYTES plain FILE NAME

Before its confinement, the process maps FILE into memory and loads the readers. See
child_process.py.
"""

from __future__ import annotations

import io
import json
import re
import sys
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
import numpy.ma  # percentiles need it, and a confined process cannot import

from sceneprint.decoders.child_process import Arrays, load_decoders, mapped, serve
from sceneprint.errors import DatasetError, UnreadableArchive
from sceneprint.formats.dataset.frame_reference import import_meta, numbered_sequences
from sceneprint.formats.points.rows import FileBytes
from sceneprint.formats.recording.bag import BagTopic, load_readers, shared_bag
from sceneprint.formats.recording.outline import bag_outline
from sceneprint.formats.recording.selection import RecordingOptions
from sceneprint.formats.recording.topics import BagSource
from sceneprint_client.api.frames import (
    MOST_RECORDING_TOPICS,
    RECORDING_OPTIONS,
    ImportOptions,
    RecordingOutline,
    RecordingTopic,
)
from sceneprint_client.errors import printable
from sceneprint_client.formats import HEAD, format_at

#: Maximum number of frames that a recording may select.
MOST_FRAMES = 100_000


class _MappedFile(io.RawIOBase):
    """A file in memory: the confined process may not seek in a real file."""

    def __init__(self, data: FileBytes) -> None:
        self._data, self._place = data, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        piece = self._data[self._place : self._place + len(buffer)]
        buffer[: len(piece)] = piece
        self._place += len(piece)
        return len(piece)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._place = offset + (0, self._place, len(self._data))[whence]
        return self._place


class _MappedPath(type(Path())):  # type: ignore[misc]  # the class of paths of this system
    """The path of the mapped recording, the only file that this process can open."""

    data: ClassVar[FileBytes] = b""

    def exists(self, **_: Any) -> bool:
        return True

    def is_dir(self, **_: Any) -> bool:
        return False

    def is_file(self, **_: Any) -> bool:
        return False  # the recording has no camera file beside it

    def absolute(self) -> _MappedPath:
        return self

    def open(self, *_: Any, **__: Any) -> BinaryIO:
        return io.BufferedReader(_MappedFile(self.data))


def _outline(path: Path, request: dict[str, Any]) -> bytes:
    """Return the outline of a recording and its selected frames as JSON; see `RecordingIndex`.

    `request["options"]` contains ImportOptions. Raise UnreadableArchive if more than `MOST_FRAMES`
    frames are selected.
    """
    options = ImportOptions.model_validate(request["options"])
    choice = RecordingOptions(**{name: getattr(options, name) for name in RECORDING_OPTIONS})
    outline = bag_outline(path, choice)
    frames = [
        {
            "name": frame.name,
            "meta": import_meta(frame, sequence, options).model_dump(
                mode="json", exclude_defaults=True
            ),
            "place": _place_of(frame.source),
        }
        for sequence in numbered_sequences(outline.sequences, options.session)
        for frame in sequence.frames[:: options.every]
    ]  # fmt: skip
    if len(frames) > MOST_FRAMES:
        raise UnreadableArchive(
            f"The recording has {len(frames)} keyframes; the limit is {MOST_FRAMES}. Increase "
            "`keyframe_m`, or split the recording."
        )
    topics = sorted(outline.topics, key=lambda topic: not outline.use_of(topic))
    record = RecordingOutline(
        kind=outline.kind, seconds=outline.seconds, span=outline.span,
        topics=[
            RecordingTopic(
                name=printable(topic.name)[:200], type=printable(topic.type)[:200],
                count=topic.count, use=outline.use_of(topic)[:200],
            )
            for topic in topics[:MOST_RECORDING_TOPICS]
        ],
        findings=[_over_http(printable(line))[:1000] for line in outline.findings[:20]],
        problem=_over_http(outline.problem)[:4000] or None,
        lost=sum(sequence.lost for sequence in outline.sequences if options.with_poses),
    )  # fmt: skip
    chosen = None if outline.chosen is None else outline.chosen.topic
    document = {
        "outline": record.model_dump(mode="json"), "frames": frames,
        "topic": None if chosen is None else [chosen.name, chosen.type],
        "sequences": len(outline.sequences),
        "notes": [sequence.note[:1000] for sequence in outline.sequences if sequence.note],
    }  # fmt: skip
    return json.dumps(document).encode()


#: Advice for the command line only.
_FOR_COMMANDS = re.compile(
    r" `sceneprint bag` lists all topics\.|, or write an intrinsics\.json beside the recording"
)
_OPTION = re.compile("--(topic|camera-info|pose-frame|sensor-frame|depth-scale)")


def _over_http(text: str) -> str:
    """Replace command options in a text with request fields; omit advice for the command line."""
    text = _FOR_COMMANDS.sub("", text)
    return _OPTION.sub(lambda option: f"`{option[1].replace('-', '_')}`", text)


def _place_of(source: Any) -> list[Any]:
    T = source.T_cloud_sensor
    return [source.log_ns, source.occurrence, None if T is None else T.tolist()]


def _frame(path: Path, request: dict[str, Any]) -> bytes:
    """Return the bytes of the frame at `request["place"]` of `request["topic"]`."""
    log_ns, occurrence, T = request["place"]
    T_cloud_sensor = None if T is None else np.array(T)
    name, kind = request["topic"]
    topic = BagTopic(name, kind, 0)
    source = BagSource(shared_bag(path), topic, log_ns, occurrence, T_cloud_sensor)
    return source.read_bytes()


def _main() -> None:
    data = _MappedPath.data = mapped(int(sys.argv[5]))
    form = format_at(bytes(data[:HEAD]), "recording")
    suffix = "" if form is None else form.suffixes[0]  # readers identify formats by their suffix
    path = _MappedPath(sys.argv[6].removesuffix(suffix) + suffix)

    def run(task: Any, request: dict[str, Any]) -> tuple[dict[str, Any], Arrays]:
        try:
            result = np.frombuffer(task(path, request), np.uint8)
        except DatasetError as error:
            raise UnreadableArchive(str(error)) from error
        return {"size": len(result)}, (result,)

    serve(
        {
            "outline": lambda _, request: run(_outline, request),
            "frame": lambda _, request: run(_frame, request),
        },
        _load,
    )


def _load(kernels: bool) -> None:
    """Load all code: a confined process cannot import."""
    load_decoders(kernels)
    load_readers()


if __name__ == "__main__":
    _main()
