"""The demo's map, filled and asked over HTTP."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from tqdm import tqdm

from sceneprint.cli.choosing import Choice, Chosen
from sceneprint.client import Client, meta_of
from sceneprint.errors import DatasetError, FrameError
from sceneprint.schemas import Added, Answer, JobState

MAP = "demo"
#: Uploads in flight.
PARALLEL = 4
#: Validated for each query, all of them: as `sceneprint evaluate` does.
CANDIDATES = 10


@dataclass(frozen=True, eq=False)
class Asked:
    """A query and its answers: of VR and of VDR, and what the latter took, seconds."""

    chosen: Chosen
    ranked: Answer
    diverse: Answer
    seconds: float


def fill(client: Client, model: str, choice: Choice) -> dict[str, Chosen]:
    """Upload the database and wait until it is signed.

    Returns
    -------
    known : the frames that are indexed, by their ids

    Raises
    ------
    DatasetError : none could be.
    """
    client.create_map(MAP, model=model)
    known: dict[str, Chosen] = {}
    jobs = []
    start = time.perf_counter()
    with ThreadPoolExecutor(PARALLEL) as pool:
        uploads = [(one, pool.submit(_upload, client, one)) for one in choice.database]
        for one, upload in tqdm(uploads, desc="upload", unit="frame", disable=None):
            try:
                added = upload.result()
            except FrameError as error:
                tqdm.write(f"left out: {one.reference.name}: {error}")
                continue
            known[added.frame_id] = one
            jobs.append(added.job_id)
    with tqdm(total=len(jobs), desc="sign", unit="frame", disable=None) as bar:

        def progress(over: int, _total: int) -> None:
            bar.update(over - bar.n)

        done = client.wait(jobs, progress=progress)
    for job in done:
        if job.state != JobState.SUCCEEDED and job.frame_id in known:
            print(f"left out: {known.pop(job.frame_id).reference.name}: {job.error}")
    if not known:
        raise DatasetError("No frame of the map could be signed; the lines above say why.")
    seconds = time.perf_counter() - start
    print(
        f"map: {len(known)} of {len(choice.database)} frames uploaded, signed and indexed in "
        f"{seconds:.1f} s, {len(known) / seconds:.1f} a second"
    )
    return known


def ask(client: Client, choice: Choice) -> list[Asked]:
    """Look every query up, without and with diversification."""
    asked = []
    for one in tqdm(choice.queries, desc="query", unit="frame", disable=None):
        meta = meta_of(one.reference, with_pose=False)  # a lost robot knows none
        path = one.reference.path
        try:
            ranked = client.query(MAP, path, meta, k=CANDIDATES, stages=("retrieve", "validate"))
            start = time.perf_counter()
            diverse = client.query(MAP, path, meta, k=CANDIDATES)
        except FrameError as error:
            tqdm.write(f"left out: {one.reference.name}: {error}")
            continue
        asked.append(Asked(one, ranked, diverse, time.perf_counter() - start))
    return asked


def _upload(client: Client, one: Chosen) -> Added:
    meta = meta_of(one.reference, session=one.session, parent_frame=one.parent)
    return client.upload(MAP, one.reference.path, meta)
