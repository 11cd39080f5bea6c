"""Learn the confidence of answers: `python -m sceneprint_lab.cli.confidence_fit --evidence FILE`.

Sites of every kind are built, most of them with maps that lack frames and whose poses drift, and
all their queries are answered. The penalties are fitted to which candidate pose was right.
Recordings take no part. With --views the frames of each map are joined to one surface, and rendered
views replace them: this learns the confidence in maps that were imported as one file.
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

#: Of a hundred queries, the number at places of each kind: a confidence is a probability among
#: queries of this mixture. Most robots are in ordinary rooms, or drive about.
SHARES: dict[str, dict[str, float]] = {
    "depth": {
        "rooms": 79, "absent": 10, "offices": 4, "opposite": 2, "object": 2, "kitchens": 1,
        "unmapped": 2,
    },
    "lidar": {
        "sites": 70, "absent": 10, "bays": 6, "streets": 6, "halls": 4, "unmapped": 4,
    },
}  # fmt: skip
#: Kinds of which more sites are built, as the evidence that decides there is rare.
TIMES = {"rooms": 3, "sites": 3, "unmapped": 2}
#: Flaws of two maps in three. Scans are taken so often that most may be missing; their poses drift
#: as it is.
FLAWS = {"depth": MapFlaws(0.5, 0.01, 0.004), "lidar": MapFlaws(0.9, 0.0, 0.0)}
#: The same of maps whose frames become one surface, which have fewer gaps.
SURFACE_FLAWS = {"depth": MapFlaws(0.3, 0.01, 0.004), "lidar": MapFlaws(0.3, 0.0, 0.0)}
#: Least step of the penalty of a pose that one view alone suggests. Two scans of a real street
#: often agree metres along it, and synthetic streets are too rich to show that.
LONE = {"depth": 0.0, "lidar": 2.5}


def collect(
    preset: str, sensor: str, seed: int, sites: int, queries: int, jobs: int, views: bool
) -> Iterator[list[SiteAnswer]]:
    """Yield ask sites of every kind with a preset, one site after another.

    Every query is answered with the best pose there is, so that frames elsewhere that look alike
    are always compared, as they are before a pose is found.

    Parameters
    ----------
    preset, sensor, seed : of the model, "depth" or "lidar", and of the sites
    sites, queries : of each kind, and of each site
    jobs : processes
    views : whether maps are views of the surface that their frames show
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
    flawed = flaws if work[1] % 3 else None
    return ask_site(signer, work, seed=seed, flaws=flawed, confidence=0.0, as_surface=views)


def read_samples(path: Path) -> list[JudgedQuery]:
    """Return the samples of a file, one JSON object a line."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return [
        JudgedQuery(
            row["site"], row["kind"], row["query"],
            tuple(PlaceEvidence(**one) for one in row["evidence"]), tuple(row["right"]),
        )
        for row in rows
    ]  # fmt: skip


def main() -> None:
    """Collect samples, fit the numbers of a preset, and write them into a model file."""
    parser = argparse.ArgumentParser(
        prog="python -m sceneprint_lab.cli.confidence_fit", description=__doc__
    )
    parser.add_argument("--preset", choices=PRESETS, default=PRESETS[0])
    parser.add_argument("--seed", type=int, default=70, help="of the sites (default: 70)")
    parser.add_argument("--sites", type=int, default=10, help="of each kind (default: 10)")
    parser.add_argument("--queries", type=int, default=12, help="of each site (default: 12)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--views", action="store_true", help="maps are views of a surface")
    parser.add_argument("--evidence", type=Path, required=True,
                        help="file of samples, which is read if it exists")  # fmt: skip
    parser.add_argument("--out", type=Path, help="model file that gets the numbers")
    options = parser.parse_args()
    model = read_model(options.preset)
    sensor = "lidar" if options.preset == "lidar" else "depth"
    if not options.evidence.exists():
        for answers in collect(options.preset, sensor, options.seed, options.sites,
                               options.queries, options.jobs, options.views):  # fmt: skip
            with options.evidence.open("a") as file:
                for one in judged_queries(answers):
                    file.write(json.dumps(asdict(one)) + "\n")
    samples = read_samples(options.evidence)
    parameters = fit(samples, SHARES[sensor], lone=0.0 if options.views else LONE[sensor])
    own = replace(model.answer.confidence, **{"views" if options.views else "frames": parameters})
    confidences = [c for one in samples for c in compute_confidences(one.evidence, own)]
    measured = calibration(confidences, [right for one in samples for right in one.right])
    print(
        f"{len(confidences)} poses; calibration error {measured.error:.3f}, "
        f"Brier {measured.brier:.4f}"
    )
    print(parameters)
    if options.out is not None:
        save_model(replace(model, answer=replace(model.answer, confidence=own)), options.out)


if __name__ == "__main__":
    main()
