"""One query over many maps, beside one over a single map of as many frames.

`python -m benchmarks.fleet.many_maps`: by FAISS on a node with SQLite, and by pgvector from a node
that holds nothing; all in one run, in turn, as the machine is shared.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fleet.bulk_load import fill, walk
from benchmarks.fleet.postgres import Server
from sceneprint.engine import Engine
from sceneprint.models import Model, read_model
from sceneprint.settings import Settings
from sceneprint_client.api import Answer, NamedFrame, Query
from sceneprint_client.api.query import Stage

#: Frames that are compared of each ranking, to see what a shortlist missed.
NEAR = 10


@dataclass(frozen=True)
class ManyFigures:
    """Medians over all queries, milliseconds, of one way to search.

    `ratio` is the median of the ratios, each of two queries one after the other; `recall` of the
    ten nearest by the exact scan, over many maps and over one.
    """

    proposer: str
    frames: int
    maps: int
    signature_bytes: int
    one: float
    many: float
    ratio: float
    quartiles: tuple[float, float]
    recall: tuple[float, float]


def measure(frames: int, maps: int, runs: int, model: Model, folder: Path) -> list[ManyFigures]:
    """Ask many maps, and one that holds the same frames.

    Parameters
    ----------
    frames : of the one map, and of the many together
    maps : how many
    runs : queries of each kind
    model : whose length the signatures have
    folder : for data, of about five times all signatures
    """
    made = walk(frames, model.signature_bytes, seed=1, walks=maps)
    asked = np.clip(
        made[np.linspace(0, frames - 1, runs + 2, dtype=int)].astype(np.int16)
        + np.random.default_rng(2).integers(-6, 7, (runs + 2, 1)), 0, 255,
    ).astype(np.uint8)  # fmt: skip
    many = [f"part-{i}" for i in range(maps)]
    found = []
    with _server(folder) as url:
        for proposer, more in (
            ("FAISS, SQLite", {"search": "local", "tail_frames": 10}),
            ("pgvector", {"search": "database", "database_url": url}),
        ):
            given: dict[str, Any] = {"data_dir": folder / proposer[:5], **more}
            with Engine(Settings.model_validate(given)) as engine:
                database = engine.store.database
                ids = fill(database, "asked", model, asked)
                fill(database, "one", model, made)
                for name, some in zip(many, np.array_split(made, maps), strict=True):
                    fill(database, name, model, some)
                engine.publish_due()
                while engine.publish_due():
                    pass
                while engine._vector_tables.run():
                    pass
                found.append(_figures(proposer, engine, ids, many, frames, model))
    return found


def _figures(
    proposer: str, engine: Engine, ids: list[str], many: list[str], frames: int, model: Model
) -> ManyFigures:
    times: list[tuple[float, float]] = []
    recalls: list[tuple[float, float]] = []
    for i, name in enumerate(ids):
        pair = [_timed(engine, name, maps) for maps in (["one"], many)]
        if i < 2:  # these compile, and open what is mapped
            continue
        times.append((pair[0], pair[1]))
        if i % 3 == 0:
            near = _ask(engine, name, ["one"], exact=True).matches[-1].distance
            recalls.append((_share(engine, name, ["one"], near), _share(engine, name, many, near)))
    one, all_ = np.transpose(times)
    ratios = all_ / one
    return ManyFigures(
        proposer=proposer,
        frames=frames,
        maps=len(many),
        signature_bytes=model.signature_bytes,
        one=1e3 * float(np.median(one)),
        many=1e3 * float(np.median(all_)),
        ratio=float(np.median(ratios)),
        quartiles=(float(np.quantile(ratios, 0.25)), float(np.quantile(ratios, 0.75))),
        recall=(float(np.mean([r[0] for r in recalls])), float(np.mean([r[1] for r in recalls]))),
    )


def _share(engine: Engine, frame: str, maps: list[str], near: int) -> float:
    """Of the nearest by the shortlist, how many are as near as the exact scan's."""
    told = _ask(engine, frame, maps, stages=("retrieve",))
    return float(np.mean([one.distance <= near for one in told.matches]))


def _ask(
    engine: Engine, frame: str, maps: list[str], *, exact: bool = False,
    stages: tuple[Stage, ...] = ("retrieve", "diversify"),
) -> Answer:  # fmt: skip
    query = Query(stages=("retrieve",) if exact else stages, k=NEAR, keep=False, exact=exact)
    return engine.queries.stored(maps, NamedFrame(map="asked", frame_id=frame), query)


def _timed(engine: Engine, frame: str, maps: list[str]) -> float:
    begin = time.perf_counter()
    _ask(engine, frame, maps)
    return time.perf_counter() - begin


@contextmanager
def _server(folder: Path) -> Iterator[str]:
    server = Server(folder / "postgres", options={"shared_buffers": "256MB"})
    server.start()
    try:
        yield server.create("maps")
    finally:
        server.stop()


def table(figures: list[ManyFigures]) -> list[str]:
    """The figures as lines of Markdown."""
    first = figures[0]
    return [
        f"### One query over {first.maps} maps, beside one map of the same {first.frames:,} frames",
        "",
        f"Signatures of {first.signature_bytes:,} bytes; a stored frame is asked, retrieved and "
        "diversified; without the 80 ms that signing an upload takes, and without validation.",
        "",
        "| shortlist | one map, ms | many, ms | ratio | quartiles | recall@10, one and many |",
        "|---|--:|--:|--:|--:|--:|",
        *(
            f"| {f.proposer} | {f.one:.1f} | {f.many:.1f} | **{f.ratio:.2f}** "
            f"| {f.quartiles[0]:.2f} to {f.quartiles[1]:.2f} "
            f"| {f.recall[0]:.3f}, {f.recall[1]:.3f} |"
            for f in figures
        ),
        "",
    ]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--maps", type=int, default=50)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--model", default="depth")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        model = read_model(options.model)
        figures = measure(options.frames, options.maps, options.runs, model, Path(folder))
    print("\n".join(table(figures)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
