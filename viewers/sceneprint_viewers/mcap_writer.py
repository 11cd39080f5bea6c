"""Writer of scenes as MCAP files with Foxglove's schemas; no other module uses foxglove-sdk.

PointSet: PointCloud on a separate topic, the entity's path
Placement: FrameTransforms on /tf, and PoseInFrame on a separate topic
UpAxis: parent frame of the space, named "SPACE upright", whose z points up
LineSet, TextLabel: SceneUpdate on one topic per group of a space
TextPage: Log on /log
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprint.atomic_files import whole_file
from sceneprint.types import Floats
from sceneprint_client.poses import quaternion_of
from sceneprint_viewers.scene import (
    Colour,
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

if TYPE_CHECKING:
    from foxglove.messages import (
        FrameTransform,
        PointCloud,
        Pose,
        SceneEntityDeletion,
        Timestamp,
        Vector3,
    )
    from foxglove.messages import SceneEntity as FoxgloveEntity

#: Time between moments without time stamps, nanoseconds.
STEP_NS = 1_000_000_000
#: Height of letters, metres.
_FONT_M = 0.08
#: Record of a point: position and colour.
_POINT = np.dtype([("position", "<f4", 3), ("colour", "u1", 4)])


class _OutputFile:
    """A file that stores the first write error, which foxglove-sdk does not report."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self.error: OSError | None = None

    def write(self, data: bytes | bytearray) -> int:
        return int(self._record_error(lambda: self._file.write(data)))

    def seek(self, offset: int, whence: int = 0) -> int:
        return int(self._record_error(lambda: self._file.seek(offset, whence)))

    def flush(self) -> None:
        self._record_error(self._file.flush)

    def close(self) -> None:
        self._record_error(self._file.close)

    def _record_error(self, work: Any) -> Any:
        try:
            return work()
        except OSError as error:
            self.error = self.error or error
            raise


@contextmanager
def mcap_file(path: Path) -> Iterator[McapWriter]:
    """Yield a writer for an MCAP file. At the end, the file replaces `path`, unless it is empty.

    Raise OSError if the file cannot be written. No partial file remains.
    """
    import foxglove

    with whole_file(path) as part:
        context, file = foxglove.Context(), _OutputFile(part)
        try:
            with closing(file), closing(foxglove.open_mcap(file, context=context)):
                writer = McapWriter(context, file)
                yield writer
                writer.finish()
        except (OSError, RuntimeError) as error:  # foxglove-sdk hides the cause
            why = file.error
            if why is None:
                raise
            raise type(why)(why.errno, why.strerror, str(path)) from error
        if writer.is_empty:
            part.unlink()


class McapWriter:
    """A writer of entities as messages."""

    def __init__(self, context: Any, file: _OutputFile) -> None:
        import foxglove.channels
        import foxglove.messages

        self._messages, self._kinds = foxglove.messages, foxglove.channels
        self._context, self._file = context, file
        self._channels: dict[tuple[str, str], Any] = {}
        #: Permanent entities, which are written with the time of the first moment.
        self._waiting: list[Moment] = []
        self._log_time = 0
        self._started = False
        #: Coordinate frames by the path of their placement.
        self._frames: dict[EntityPath, str] = {}

    def write(self, moment: Moment, gone: Collection[SceneEntity]) -> None:
        """Write a moment; permanent entities wait until the first moment with an index."""
        if moment.index is not None:
            stamp = moment.stamp_ns
            self._log_time = moment.index * STEP_NS if stamp is None else stamp
            if not self._started:
                self._start()
        elif not self._started:
            self._waiting.append(moment)
            return
        self._write(moment.entities, gone)

    @property
    def is_empty(self) -> bool:
        """Return whether nothing was written."""
        return not self._started and not self._waiting

    def finish(self) -> None:
        """Write the permanent entities if no moment was added."""
        if self._waiting:
            self._start()

    def _start(self) -> None:
        self._started = True
        for static in self._waiting:
            self._write(static.entities, ())
        self._waiting.clear()

    def _write(self, entities: Sequence[SceneEntity], gone: Collection[SceneEntity]) -> None:
        now = self._messages.Timestamp(*divmod(self._log_time, 1_000_000_000))
        for entity in gone:
            self._frames.pop(entity.path, None)
        self._write_frames(entities, now)
        self._write_groups(entities, gone, now)
        for entity in entities:
            if isinstance(entity.content, PointSet):
                self._log("PointCloud", entity.path, self._cloud(entity.path, entity.content, now))
            elif isinstance(entity.content, TextPage):
                level = self._messages.LogLevel.Info
                text = self._messages.Log(
                    timestamp=now, level=level, message=entity.content.text, name="sceneprint"
                )
                self._log("Log", ("log",), text)
        for entity in gone:
            if isinstance(entity.content, PointSet):  # an empty cloud replaces it
                nothing = PointSet(
                    np.zeros((0, 3)), np.zeros((0, 3), np.uint8), entity.content.size_m
                )
                self._log("PointCloud", entity.path, self._cloud(entity.path, nothing, now))
        if self._file.error is not None:
            raise self._file.error

    def _write_frames(self, entities: Sequence[SceneEntity], now: Timestamp) -> None:
        """Write placements as transforms, and as poses that Foxglove draws as axes."""
        m = self._messages
        transforms: list[FrameTransform] = []
        for entity in entities:
            if isinstance(entity.content, UpAxis):
                space, T = space_of(entity.path), upright(entity.content.up)
                transforms.append(self._transform(f"{space} upright", space, T, now))
            elif isinstance(entity.content, Placement):
                parent, T = self._frame_of(entity.path[:-1]), entity.content.T_parent_child
                self._frames[entity.path] = entity.content.child
                transforms.append(self._transform(parent, entity.content.child, T, now))
                pose = m.PoseInFrame(timestamp=now, frame_id=parent, pose=self._pose(T))
                self._log("PoseInFrame", (*entity.path, "pose"), pose)
        if transforms:
            self._log("FrameTransforms", ("tf",), m.FrameTransforms(transforms=transforms))

    def _write_groups(
        self, entities: Sequence[SceneEntity], gone: Collection[SceneEntity], now: Timestamp
    ) -> None:
        """Write lines and labels by group, and delete the entities in `gone`."""
        m = self._messages
        groups: defaultdict[EntityPath, tuple[list[FoxgloveEntity], list[SceneEntityDeletion]]]
        groups = defaultdict(lambda: ([], []))
        for entity in entities:
            if isinstance(entity.content, LineSet | TextLabel):
                groups[entity.path[:2]][0].append(self._drawn(entity.path, entity.content, now))
        for entity in gone:
            if isinstance(entity.content, LineSet | TextLabel):
                deletion = m.SceneEntityDeletion(timestamp=now, id=_topic(entity.path))
                groups[entity.path[:2]][1].append(deletion)
        for path, (drawn, deletions) in groups.items():
            self._log("SceneUpdate", path, m.SceneUpdate(deletions=deletions, entities=drawn))

    def _drawn(
        self, path: EntityPath, content: LineSet | TextLabel, now: Timestamp
    ) -> FoxgloveEntity:
        m = self._messages
        lines, texts = [], []
        if isinstance(content, LineSet):
            for strip, colour in zip(content.strips, content.colours, strict=True):
                points = [m.Point3(x=x, y=y, z=z) for x, y, z in np.asarray(strip, float).tolist()]
                lines.append(
                    m.LinePrimitive(
                        pose=self._pose(np.eye(4)), points=points, color=self._colour(colour),
                        thickness=content.width_px, scale_invariant=True,
                    )
                )  # fmt: skip
        else:
            T = np.eye(4)
            T[:3, 3] = content.position
            texts.append(
                m.TextPrimitive(
                    pose=self._pose(T), billboard=True, font_size=_FONT_M,
                    color=self._colour(content.colour), text=content.text,
                )
            )  # fmt: skip
        drawn: FoxgloveEntity = m.SceneEntity(
            timestamp=now, frame_id=self._frame_of(path), id=_topic(path), lines=lines, texts=texts
        )
        return drawn

    def _cloud(self, path: EntityPath, content: PointSet, now: Timestamp) -> PointCloud:
        m = self._messages
        kinds = m.PackedElementFieldNumericType
        rows = np.empty(len(content.points), _POINT)
        rows["position"] = content.points
        rows["colour"][:, :3] = content.colours
        rows["colour"][:, 3] = 255
        positions = [
            m.PackedElementField(name=name, offset=4 * i, type=kinds.Float32)
            for i, name in enumerate("xyz")
        ]
        colours = [
            m.PackedElementField(name=name, offset=12 + i, type=kinds.Uint8)
            for i, name in enumerate(("red", "green", "blue", "alpha"))
        ]
        cloud: PointCloud = m.PointCloud(
            timestamp=now, frame_id=self._frame_of(path), pose=self._pose(np.eye(4)),
            point_stride=_POINT.itemsize, fields=positions + colours, data=rows.tobytes(),
        )  # fmt: skip
        return cloud

    def _frame_of(self, path: EntityPath) -> str:
        """Return the frame of the nearest placement on a path, or else the space."""
        for end in range(len(path), 0, -1):
            if path[:end] in self._frames:
                return self._frames[path[:end]]
        return space_of(path)

    def _log(self, kind: str, path: EntityPath, message: object) -> None:
        """Write a message of a kind, such as "PointCloud", on the topic of a path."""
        topic = _topic(path)
        if (kind, topic) not in self._channels:
            make = getattr(self._kinds, f"{kind}Channel")
            self._channels[kind, topic] = make(topic, context=self._context)
        self._channels[kind, topic].log(message, log_time=self._log_time)

    def _transform(self, parent: str, child: str, T: Floats, now: Timestamp) -> FrameTransform:
        transform: FrameTransform = self._messages.FrameTransform(
            timestamp=now, parent_frame_id=parent, child_frame_id=child,
            translation=self._vector(T[:3, 3]), rotation=self._quaternion(T),
        )  # fmt: skip
        return transform

    def _vector(self, at: Floats) -> Vector3:
        x, y, z = at.tolist()
        return self._messages.Vector3(x=x, y=y, z=z)

    def _quaternion(self, T: Floats) -> Any:
        x, y, z, w = quaternion_of(T[:3, :3]).tolist()
        return self._messages.Quaternion(x=x, y=y, z=z, w=w)

    def _pose(self, T: Floats) -> Pose:
        return self._messages.Pose(position=self._vector(T[:3, 3]), orientation=self._quaternion(T))

    def _colour(self, colour: Colour) -> Any:
        r, g, b = (value / 255 for value in colour)
        return self._messages.Color(r=r, g=g, b=b, a=1.0)


def upright(up: Floats) -> Floats:
    """Return a transform (4, 4) that rotates `up` (3,) to z, the up axis of Foxglove."""
    level = np.zeros(3)
    level[int(np.argmin(np.abs(up)))] = 1.0
    level -= (level @ up) * up
    level /= np.linalg.norm(level)
    T = np.eye(4)
    T[:3, :3] = level, np.cross(up, level), up
    return T


def _topic(path: EntityPath) -> str:
    """Return the topic of a path, with slashes between its parts."""
    return "/" + "/".join(part.strip("/").replace(" ", "_") for part in path)
