"""Reconstructions from the matches of a query.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal, Protocol, cast

from sceneprint.client.frames import checked
from sceneprint.client.messages import query_path, reconstruction_path
from sceneprint.client.sending import Sender
from sceneprint.schemas import Answer
from sceneprint.schemas.reconstructions import NewReconstruction, Reconstruction

if TYPE_CHECKING:
    from sceneprint.client.backend import Backend
    from sceneprint.engine import Engine

_MESH, _PICTURE = "mesh.ply", "picture.png"


class ReconstructionsBackend(Protocol):
    """What this topic needs of whoever does the work."""

    def reconstruct(self, query_id: str, wanted: NewReconstruction) -> Reconstruction:
        """Begin a reconstruction."""

    def get_reconstruction(self, job_id: str) -> Reconstruction:
        """A reconstruction."""

    def reconstruction_file(self, job_id: str, name: str) -> bytes:
        """A file that it made."""

    def delete_reconstruction(self, job_id: str) -> None:
        """Remove it with its files."""


class RemoteReconstructions(Sender):
    """Over HTTP."""

    def reconstruct(self, query_id: str, wanted: NewReconstruction) -> Reconstruction:
        """Begin a reconstruction."""
        body = wanted.model_dump(mode="json", exclude_unset=True)
        path = f"{query_path(query_id)}/reconstruction"
        return self._ask(Reconstruction, "POST", path, json=body)

    def get_reconstruction(self, job_id: str) -> Reconstruction:
        """A reconstruction."""
        return self._ask(Reconstruction, "GET", reconstruction_path(job_id))

    def reconstruction_file(self, job_id: str, name: str) -> bytes:
        """A file that it made."""
        return self._bytes("GET", f"{reconstruction_path(job_id)}/{name}")

    def delete_reconstruction(self, job_id: str) -> None:
        """Remove it with its files."""
        self._delete(reconstruction_path(job_id))


class EmbeddedReconstructions:
    """In this process."""

    _engine: Engine

    def reconstruct(self, query_id: str, wanted: NewReconstruction) -> Reconstruction:
        """Begin a reconstruction."""
        return self._engine.reconstructions.begin(self._engine.kept.find(query_id), wanted)

    def get_reconstruction(self, job_id: str) -> Reconstruction:
        """A reconstruction."""
        return self._engine.reconstructions.find(job_id)

    def reconstruction_file(self, job_id: str, name: str) -> bytes:
        """A file that it made."""
        return self._engine.store.blobs.get(self._engine.reconstructions.file(job_id, name).blob)

    def delete_reconstruction(self, job_id: str) -> None:
        """Remove it with its files."""
        self._engine.reconstructions.delete(job_id)


class Reconstructions:
    """The calls."""

    _backend: ReconstructionsBackend

    def reconstruct(
        self, query: str | Answer, *, frames: Iterable[str] | None = None,
        strength: Literal["strong", "any"] = "any", include_query: bool = True,
        voxel_m: float | None = None, output: Literal["mesh", "cloud"] = "mesh",
        wait_s: float | None = None,
    ) -> Reconstruction:  # fmt: skip
        """Fuse the accepted matches of an answer to a surface, in the query's camera frame.

        Parameters
        ----------
        query : the answer, or the id of its query; answers are kept for an hour
        frames, strength, include_query, voxel_m, output : see NewReconstruction
        wait_s : seconds to wait until it is done; default: none

        Returns
        -------
        reconstruction : `coverage` is there when its state is `succeeded`; `error` says why not

        Raises
        ------
        UnknownQuery : the answer is not kept, or no longer.
        InvalidRequest : it has no accepted match, or not those that are named.
        """
        chosen = None if frames is None else tuple(frames)
        wanted = checked(
            NewReconstruction, "The reconstruction", frames=chosen, strength=strength,
            include_query=include_query, voxel_m=voxel_m, output=output,
        )  # fmt: skip
        query_id = query if isinstance(query, str) else query.query_id
        made = self._backend.reconstruct(query_id, wanted)
        if wait_s is None:
            return made
        from sceneprint.client.waiting import wait_for

        wait_for(cast("Backend", self._backend), [made.job_id], wait_s, None)
        return self._backend.get_reconstruction(made.job_id)

    def reconstruction(self, job_id: str) -> Reconstruction:
        """A reconstruction as it is now; UnknownJob where there is none."""
        return self._backend.get_reconstruction(job_id)

    def reconstruction_mesh(self, job_id: str) -> bytes:
        """Its surface as a PLY file.

        Raises
        ------
        UnknownJob : there is no such reconstruction.
        NotIndexed : it is not done, or has failed.
        """
        return self._backend.reconstruction_file(job_id, _MESH)

    def reconstruction_picture(self, job_id: str) -> bytes:
        """Its picture as a PNG file; see `reconstruction_mesh`."""
        return self._backend.reconstruction_file(job_id, _PICTURE)

    def delete_reconstruction(self, job_id: str) -> None:
        """Remove a reconstruction with its files; UnknownJob where there is none."""
        self._backend.delete_reconstruction(job_id)
