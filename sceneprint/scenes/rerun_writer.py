"""Scenes for Rerun: an .rrd file, or a viewer while it runs. The boundary to rerun-sdk.

An entity lies at its path, and below a placement's path is its frame, as Rerun has it.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol
from urllib.parse import urlsplit

import numpy as np

from sceneprint.atomic_files import whole_file
from sceneprint.errors import InvalidRequest, MissingDependency, Unreachable
from sceneprint.scenes.scene import (
    EntityPath,
    LineSet,
    Moment,
    Placement,
    PointSet,
    SceneEntity,
    TextLabel,
    TextPage,
    UpAxis,
    space_of,
)
from sceneprint_client.poses import quaternion_of

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "sceneprint"
#: Where a viewer of this machine listens.
VIEWER_URL = "rerun+http://127.0.0.1:9876/proxy"
_SCHEMES = ("rerun", "rerun+http", "rerun+https")
#: Longest wait for a viewer that was started, for a connection, and for it to take all, seconds.
_START_S, _CONNECT_S, _FLUSH_S = 60.0, 2.0, 60.0
#: Timelines: frames in the order in which they were asked, and when they were taken.
INDEX, TIME = "frame", "time"
#: Radius of the dot that carries a label, metres.
_DOT_M = 0.01
_COORDINATES = {
    (0, 1): "RIGHT_HAND_X_UP", (0, -1): "RIGHT_HAND_X_DOWN", (1, 1): "RIGHT_HAND_Y_UP",
    (1, -1): "RIGHT_HAND_Y_DOWN", (2, 1): "RIGHT_HAND_Z_UP", (2, -1): "RIGHT_HAND_Z_DOWN",
}  # fmt: skip


def require_rerun() -> None:
    """See that rerun-sdk is there.

    Raises
    ------
    MissingDependency : it is not installed.
    """
    try:
        import rerun  # noqa: F401
    except ImportError as cause:
        raise MissingDependency(
            "Scenes for Rerun are written with rerun-sdk, which is not installed. "
            "Run: pip install 'sceneprint[rerun]'"
        ) from cause


class RerunSink(Protocol):
    """Where a recording goes."""

    def open(self, stream: rr.RecordingStream) -> None:
        """Lead the stream there; before anything is logged."""

    def check(self) -> None:
        """Raise the OSError that has kept it from being written, if any."""


class _FileSink:
    """A file, written through a pipe.

    Where a disk is full, rerun-sdk waits for ever for its own writer; so that writes to a pipe, and
    a thread of ours from there to the file.
    """

    def __init__(self, part: Path, path: Path) -> None:
        self._part, self._path = part, path
        self._thread: threading.Thread | None = None
        self._error: OSError | None = None

    def open(self, stream: rr.RecordingStream) -> None:
        reader, writer = os.pipe()
        self._thread = threading.Thread(target=self._copy, args=(reader,), daemon=True)
        self._thread.start()
        try:
            stream.save(f"/dev/fd/{writer}")
        finally:
            os.close(writer)  # the stream has its own

    def check(self) -> None:
        if self._error is not None:
            why = self._error
            raise type(why)(why.errno, why.strerror, str(self._path)) from why

    def close(self) -> None:
        """Wait for the last bytes of a stream that is disconnected."""
        if self._thread is not None:
            self._thread.join()

    def _copy(self, reader: int) -> None:
        with open(reader, "rb", buffering=0) as pipe:
            try:
                with self._part.open("wb") as file:
                    shutil.copyfileobj(pipe, file)
            except OSError as error:
                self._error = error
                while pipe.read(1 << 20):  # nobody must wait for us
                    pass


@contextmanager
def rerun_file(path: Path, title: str) -> Iterator[RerunWriter]:
    """A writer of an .rrd file, which is there when the block ends well and wrote something.

    Raises
    ------
    OSError : it cannot be written; nothing is left behind.
    """
    with whole_file(path) as part:
        sink = _FileSink(part, path)
        writer = RerunWriter(title, sink)
        try:
            yield writer
            writer.finish()
        finally:
            writer.stream.disconnect()
            sink.close()
        sink.check()


class _ViewerSink:
    """A viewer that runs."""

    def __init__(self, url: str) -> None:
        self._url = url

    def open(self, stream: rr.RecordingStream) -> None:
        stream.connect_grpc(self._url)

    def check(self) -> None:
        pass  # a viewer that went away is noticed at the end


@contextmanager
def rerun_viewer(url: str | None, title: str) -> Iterator[RerunWriter]:
    """A writer to a viewer that runs.

    Parameters
    ----------
    url : where it listens; None for that of this machine, which is started where none listens
    title : of the recording

    Raises
    ------
    InvalidRequest : the address is none of a viewer.
    Unreachable : no viewer listens there, it does not start, or went away.
    """
    if url is None:
        start_viewer()
    else:
        check_viewer(url)
    writer = RerunWriter(title, _ViewerSink(url or VIEWER_URL))
    try:
        yield writer
        writer.finish()
    except RuntimeError as error:
        raise Unreachable(f"The Rerun viewer does not take the scene: {error}") from error
    finally:
        writer.stream.disconnect()


def check_viewer(url: str) -> None:
    """See that a viewer listens at an address.

    Raises
    ------
    InvalidRequest : the address is none of a viewer.
    Unreachable : nobody listens there.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or parts.scheme not in _SCHEMES or parts.path != "/proxy":
        raise InvalidRequest(
            f"{url!r:.200} is not the address of a Rerun viewer. Write it like {VIEWER_URL}."
        )
    if not _listens(host, port or 9876):
        raise Unreachable(
            f"No Rerun viewer listens at {url}. Start one there with `rerun`, or write a file "
            "with --rrd."
        )


def start_viewer() -> None:
    """Start a viewer on this machine, for this machine alone, unless one listens already.

    Raises
    ------
    Unreachable : it does not start.
    """
    parts = urlsplit(VIEWER_URL)
    host, port = str(parts.hostname), parts.port or 9876
    if _listens(host, port):
        return
    command = [
        sys.executable, "-m", "rerun_cli", "--bind", host, "--port", str(port),
        "--expect-data-soon",
    ]  # fmt: skip
    viewer = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    until = time.monotonic() + _START_S
    while time.monotonic() < until and viewer.poll() is None:
        if _listens(host, port):
            return
        time.sleep(0.1)
    raise Unreachable(
        "The Rerun viewer did not start; it needs a display. Write a file with --rrd and open it "
        "elsewhere, or send to another machine's viewer with --rerun-url."
    )


def _listens(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), _CONNECT_S).close()
    except OSError:
        return False
    return True


class RerunWriter:
    """Entities to a recording.

    Parameters
    ----------
    title : of the recording
    sink : where it goes; opened before the first moment
    """

    def __init__(self, title: str, sink: RerunSink) -> None:
        import rerun as rr

        self._rr, self._title, self._sink = rr, title, sink
        self.stream = rr.RecordingStream(APPLICATION)
        self.stream.set_log_tick_enabled(False)
        self.stream.set_log_time_enabled(False)
        self._is_open = False
        self._spaces: list[str] = []
        self._has_text = False

    def write(self, moment: Moment, gone: Collection[SceneEntity]) -> None:
        """Log a moment; see `SceneWriter`."""
        if not self._is_open:
            self._is_open = True
            self._sink.open(self.stream)
            self.stream.send_recording_name(self._title)
        static = moment.index is None
        if moment.index is not None:
            self.stream.reset_time()
            self.stream.set_time(INDEX, sequence=moment.index)
            if moment.stamp_ns is not None:
                self.stream.set_time(TIME, timestamp=np.datetime64(moment.stamp_ns, "ns"))
        for one in gone:
            self._log(one.path, [self._rr.Clear(recursive=False)], static=False)
        for one in moment.entities:
            self._log(one.path, self._archetypes(one), static=static)
        self._show(moment)
        self._sink.check()

    def finish(self) -> None:
        """Wait until all is written; RuntimeError where it cannot be."""
        if self._is_open:
            self.stream.flush(timeout_sec=_FLUSH_S)

    def _log(self, path: EntityPath, content: Sequence[rr.AsComponents], *, static: bool) -> None:
        place = self._rr.new_entity_path(list(path))
        self.stream.log(place, *content, static=static, strict=True)

    def _archetypes(self, entity: SceneEntity) -> list[rr.AsComponents]:
        """What Rerun draws for an entity."""
        rr, content = self._rr, entity.content
        if isinstance(content, PointSet):
            radius = content.size_m / 2
            return [rr.Points3D(content.points, colors=content.colours, radii=radius)]
        if isinstance(content, LineSet):
            strips = [np.asarray(one, np.float32) for one in content.strips]
            radius = -content.width_px / 2  # negative: of the screen, not metres
            return [rr.LineStrips3D(strips, colors=content.colours, radii=radius)]
        if isinstance(content, TextLabel):
            return [
                rr.Points3D(
                    [content.position], labels=[content.text], colors=[content.colour],
                    radii=_DOT_M, show_labels=True,
                )
            ]  # fmt: skip
        if isinstance(content, Placement):
            T = content.T_parent_child
            q = rr.Quaternion(xyzw=quaternion_of(T[:3, :3]))
            return [rr.Transform3D(translation=T[:3, 3], quaternion=q)]
        if isinstance(content, UpAxis):
            axis = int(np.argmax(np.abs(content.up)))
            name = _COORDINATES[axis, 1 if content.up[axis] >= 0 else -1]
            return [getattr(rr.ViewCoordinates, name)]
        # a fence keeps columns in columns; what a name holds must not end it
        text = content.text.replace("`", "'")
        return [rr.TextDocument(f"```\n{text}\n```", media_type=rr.MediaType.MARKDOWN)]

    def _show(self, moment: Moment) -> None:
        """Lay out a view for each space, the text beside them, when there is a new one."""
        import rerun.blueprint as rrb

        texts = {one.path for one in moment.entities if isinstance(one.content, TextPage)}
        spaces = {space_of(one.path) for one in moment.entities if one.path not in texts}
        new = sorted(spaces - set(self._spaces))
        if not new and (self._has_text or not texts):
            return
        self._spaces += new
        self._has_text = self._has_text or bool(texts)
        views: list[rrb.View | rrb.Container] = [
            rrb.Spatial3DView(origin=self._rr.new_entity_path([name]), name=name)
            for name in self._spaces
        ]
        layout: rrb.View | rrb.Container = views[0] if len(views) == 1 else rrb.Tabs(*views)
        if self._has_text:
            text = rrb.TextDocumentView(origin="/answer", name="answer")
            layout = rrb.Vertical(layout, text, row_shares=[3, 1])
        self.stream.send_blueprint(rrb.Blueprint(layout, collapse_panels=True))
