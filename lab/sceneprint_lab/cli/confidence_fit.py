"""Fit the confidence of answers: `python -m sceneprint_lab.cli.confidence_fit --evidence FILE`.

The command generates sites of all kinds, most of them with incomplete maps and drifting poses,
answers all queries at these sites, and fits the penalties to the candidate poses and to whether
each is right. No recordings are used. With --views, the frames of each map are fused into a surface
and replaced by rendered views of it, to fit the confidence for maps that were imported as a whole.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from tqdm import tqdm

from sceneprint.geometry.validation.confidence import PlaceEvidence, compute_confidences
from sceneprint.models import PRESETS, read_model
from sceneprint.models.model_file import save_model
from sceneprint.pipeline import Signer, open_signer
from sceneprint_lab.confidence import JudgedQuery, fit, judged_queries
from sceneprint_lab.evaluation.measures import calibration
from sceneprint_lab.evaluation.protocol import map_over
from sceneprint_lab.evaluation.sites import MapFlaws, SiteAnswer, ask_site

#: Percentage of queries at each kind of place. Confidences are probabilities for this mixture of
#: queries, most of which come from ordinary places.
SHARES: dict[str, dict[str, float]] = {
    "depth": {
        "rooms": 79, "absent": 10, "offices": 4, "opposite": 2, "object": 2, "kitchens": 1,
        "unmapped": 2,
    },
    "lidar": {
        "sites": 80, "absent": 10, "bays": 2.5, "streets": 2.5, "halls": 2.5, "unmapped": 2.5,
    },
}  # fmt: skip
#: Factors by which there are more sites of those kinds whose decisive evidence is rare.
TIMES = {"rooms": 3, "sites": 3, "unmapped": 2}
#: Flaws of two maps in three. Scans are dense, so most of them may be missing; the poses of scans
#: already drift.
FLAWS = {"depth": MapFlaws(0.5, 0.01, 0.004), "lidar": MapFlaws(0.9, 0.0, 0.0)}
#: Flaws of maps whose frames are fused into a surface, which has fewer gaps.
SURFACE_FLAWS = {"depth": MapFlaws(0.3, 0.01, 0.004), "lidar": MapFlaws(0.3, 0.0, 0.0)}


def collect(
    preset: str, sensor: str, seed: int, sites: int, queries: int, jobs: int, views: bool
) -> Iterator[list[SiteAnswer]]:
    """Yield the answers to the queries of each site, for all kinds of sites of a sensor.

    The minimum confidence is 0, so frames of similar places are always compared.

    Parameters
    ----------
    preset, sensor, seed : model, sensor ("depth" or "lidar"), and seed of the sites
    sites, queries : number of sites per kind, and of queries per site
    jobs : number of processes
    views : whether a map consists of views of the surface that is fused from its frames
    """
    work = [
        (kind, index * TIMES.get(kind, 1) + k, queries)
        for index in range(sites)
        for kind in SHARES[sensor]
        for k in range(TIMES.get(kind, 1))
    ]
    flaws = (SURFACE_FLAWS if views else FLAWS)[sensor]
    ask = partial(_ask, seed=seed, flaws=flaws, views=views)
    answered = map_over(work, ask, partial(open_signer, preset), jobs)
    yield from tqdm(answered, total=len(work), disable=None)


def _ask(
    signer: Signer, work: tuple[str, int, int], *, seed: int, flaws: MapFlaws, views: bool
) -> list[SiteAnswer]:
    """Return the answers at a site (kind, index, query count); two maps in three have flaws."""
    flawed = flaws if work[1] % 3 else None
    return ask_site(signer, work, seed=seed, flaws=flawed, confidence=0.0, as_surface=views)


def read_samples(path: Path) -> list[JudgedQuery]:
    """Return the samples in a file that has one JSON object per line."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return [
        JudgedQuery(
            row["site"], row["kind"], row["query"],
            tuple(PlaceEvidence(**fields) for fields in row["evidence"]), tuple(row["right"]),
        )
        for row in rows
    ]  # fmt: skip


def main() -> None:
    """Fit the parameters of a preset to samples, and write them to the model file of `--out`.

    If the file of `--evidence` does not exist, create it with samples from generated sites.
    """
    parser = argparse.ArgumentParser(
        prog="python -m sceneprint_lab.cli.confidence_fit", description=__doc__
    )
    parser.add_argument("--preset", choices=PRESETS, default=PRESETS[0])
    parser.add_argument("--seed", type=int, default=70, help="seed of the sites (default: 70)")
    parser.add_argument("--sites", type=int, default=10, help="sites of each kind (default: 10)")
    parser.add_argument("--queries", type=int, default=12, help="queries per site (default: 12)")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes (default: 1)")
    parser.add_argument("--views", action="store_true", help="use views of a fused surface as maps")
    parser.add_argument("--evidence", type=Path, required=True,
                        help="file of samples; if it exists, it is read")  # fmt: skip
    parser.add_argument("--out", type=Path, help="model file to write")
    options = parser.parse_args()
    model = read_model(options.preset)
    sensor = "lidar" if options.preset == "lidar" else "depth"
    if not options.evidence.exists():
        for answers in collect(options.preset, sensor, options.seed, options.sites,
                               options.queries, options.jobs, options.views):  # fmt: skip
            with options.evidence.open("a") as file:
                for query in judged_queries(answers):
                    file.write(json.dumps(asdict(query)) + "\n")
    samples = read_samples(options.evidence)
    parameters = fit(samples, SHARES[sensor])
    own = replace(model.answer.confidence, **{"views" if options.views else "frames": parameters})
    confidences = [c for query in samples for c in compute_confidences(query.evidence, own)]
    measured = calibration(confidences, [right for query in samples for right in query.right])
    print(
        f"{len(confidences)} poses; calibration error {measured.error:.3f}, "
        f"Brier {measured.brier:.4f}"
    )
    print(parameters)
    if options.out is not None:
        save_model(replace(model, answer=replace(model.answer, confidence=own)), options.out)


if __name__ == "__main__":
    main()
