"""Files in which the commands of `sceneprint` draw their results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from sceneprint_client import Client
from sceneprint_client.api import Answer, Frame
from sceneprint_client.api.base import CameraIntrinsics
from sceneprint_client.api.sessions import Association
from sceneprint_viewers.answer_scene import MANY, ONE, AnswerScene, association_scene
from sceneprint_viewers.map_scene import frame_scene, frames_scene
from sceneprint_viewers.mcap_writer import mcap_file
from sceneprint_viewers.scene import SceneStream


class SceneFile:
    """A scene in which the commands of `sceneprint` draw their results.

    Parameters
    ----------
    stream : output of the scene
    map_frames : number of frames of each map whose points are drawn; 0 draws no map
    """

    def __init__(self, stream: SceneStream, client: Client, map_frames: int) -> None:
        self._stream, self._client, self._map_frames = stream, client, map_frames
        self._answers: AnswerScene | None = None

    @property
    def is_empty(self) -> bool:
        """Return whether nothing was added."""
        return self._stream.is_empty

    def add_answer(
        self, answer: Answer, name: str, text: str, camera: CameraIntrinsics | None,
        place: tuple[int, int], stamp_ns: int | None,
    ) -> None:  # fmt: skip
        """Add an answer as the next moment, and draw its map if that was not drawn.

        `place` is the index of the answer and the total number; see `AnswerScene.add`.
        """
        index, of = place
        if self._answers is None:
            limits = ONE if of == 1 else MANY
            self._answers = AnswerScene(self._stream, self._client, limits, self._map_frames)
        self._answers.add(answer, name, text, camera, index, stamp_ns)

    def add_frame(self, frame: Frame) -> None:
        """Draw one frame of a map."""
        self._stream.write(frame_scene(self._client, frame))

    def add_frames(self, frames: Sequence[Frame]) -> None:
        """Draw posed frames of one map."""
        self._stream.write(frames_scene(self._client, frames, self._map_frames))

    def add_association(self, association: Association, text: str) -> None:
        """Draw the result of an association."""
        moment = association_scene(self._client, association, text, self._map_frames)
        self._stream.write(moment)


@contextmanager
def open_scene_file(path: Path, client: Client, map_frames: int) -> Iterator[SceneFile]:
    """Yield an MCAP file for drawing, which is created at the end unless nothing was drawn.

    Raise OSError if the file cannot be written. No partial file remains.
    """
    with mcap_file(path) as writer:
        yield SceneFile(SceneStream(writer), client, map_frames)
