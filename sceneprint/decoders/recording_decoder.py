"""Reading of ROS recordings in a confined process that inherits the open file.

descriptor, name  --RecordingDecoder-->  outline(options), frame(topic, place)
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from sceneprint.decoders.pool import ConfinedDecoder, DecoderProcess
from sceneprint.errors import DecoderFailure, UnreadableArchive
from sceneprint_client.api.frames import ImportOptions, RecordingOutline
from sceneprint_client.files import MAXIMUM_CLOUD_BYTES

_PROGRAM = "sceneprint.decoders.recording_process"
#: Maximum memory that the process may allocate besides the file, bytes.
_MORE_BYTES = 2 << 30


@dataclass(frozen=True, eq=False)
class RecordingIndex:
    """The outline of a recording, and the frames that are selected for import.

    Parameters
    ----------
    outline : content of the recording
    topic : name and type of the frames' topic
    frames : name, metadata and place in the recording of each frame
    sequences : number of sequences
    """

    outline: RecordingOutline
    topic: tuple[str, str] | None
    frames: list[dict[str, Any]]
    notes: list[str]
    sequences: int

    @classmethod
    def parse(cls, text: bytes) -> RecordingIndex:
        """Parse a document; raise ValueError, KeyError or TypeError if it is invalid."""
        document = json.loads(text)
        topic = document["topic"]
        return cls(
            RecordingOutline.model_validate(document["outline"]),
            None if topic is None else (str(topic[0]), str(topic[1])),
            [
                {name: frame[name] for name in ("name", "meta", "place")}
                for frame in document["frames"]
            ],
            [str(note) for note in document["notes"]],
            int(document["sequences"]),
        )


class RecordingDecoder:
    """A confined process with an open recording, for use by one thread.

    Parameters
    ----------
    file : descriptor of the recording
    name : name of the file; its suffix identifies the format
    seconds : maximum processor time per request
    """

    def __init__(self, file: int, name: str, seconds: float) -> None:
        self._name = name
        self._decoder = ConfinedDecoder(_PROGRAM, _MORE_BYTES, seconds, files=(file,), more=(name,))

    def close(self) -> None:
        """Kill the process."""
        self._decoder.end()

    def outline(self, options: ImportOptions) -> tuple[bytes, RecordingIndex]:
        """Return the index of the recording, as JSON for `RecordingIndex.parse` and parsed.

        Raise UnreadableArchive if the recording cannot be read with the memory and time of a
        process. Raise Busy if no process can be started.
        """
        fields = options.model_dump(mode="json", by_alias=True)
        text = self._run({"task": "outline", "options": fields})
        try:
            return text, RecordingIndex.parse(text)
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise UnreadableArchive(f"{self._name}: Its outline is invalid.") from error

    def frame(self, topic: tuple[str, str], place: list[Any]) -> bytes:
        """Return the bytes of the frame at a `place` of `RecordingIndex.frames`.

        Raises
        ------
        UnreadableFrame, UnreadableCloud : If the message is damaged.
        UnreadableArchive : If the recording cannot be read.
        Busy : If no process can be started.
        """
        return self._run({"task": "frame", "topic": topic, "place": place})

    def _run(self, request: dict[str, Any]) -> bytes:
        """Return the data of a reply; raise UnreadableArchive if the process fails."""

        def check(process: DecoderProcess, reply: dict[str, Any]) -> bytes:
            size = int(reply["size"])
            if not 0 <= size <= MAXIMUM_CLOUD_BYTES:
                raise ValueError(f"{size} bytes")
            return process.array_of("u1", (size,)).tobytes()

        try:
            data: bytes = self._decoder.run(request, b"", check)
        except DecoderFailure as error:
            raise UnreadableArchive(
                f"{self._name} cannot be read: {error}. Split the recording, or send only the "
                "topics of the sensor, its camera, /tf and /tf_static."
            ) from error
        return data
