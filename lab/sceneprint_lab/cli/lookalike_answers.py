"""Answer queries at ambiguous places: `python -m sceneprint_lab.cli.lookalike_answers`.

With `--model lidar`, the sites consist of laser scans. An answer is then correct within 50 cm and
10 degrees, and grossly wrong beyond 2.5 m or 15 degrees.

Use seeds 1 to 99 to tune parameters, and unused seeds from 1000 for the final evaluation.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sceneprint.models import PRESETS, read_model
from sceneprint.pipeline import open_signer
from sceneprint_lab.evaluation.measures import answers
from sceneprint_lab.evaluation.protocol import map_over
from sceneprint_lab.evaluation.sites import SiteAnswer, ask_site, kinds_of
from sceneprint_lab.synth.lookalike_surveys import SURVEYED_KINDS
from sceneprint_lab.synth.lookalikes import KINDS, ORDINARY

#: Number of queries per site with --absent, which requires thousands of queries in total.
ABSENT_BLOCK = 100
#: Columns of the table, and the key of each in the result of `measures.answers`.
SHARES = {
    "found and right": "found_right", "found and wrong": "found_wrong",
    "wrong of found": "wrong_of_found", "grossly wrong": "grossly_wrong",
    "at most": "grossly_wrong_at_most", "called strong": "found_strong_wrong",
    "ambiguous": "ambiguous", "not found": "not_found",
}  # fmt: skip


def table(site_answers: Sequence[SiteAnswer]) -> list[str]:
    """Return a table of SHARES for each kind and in total, as lines of Markdown."""
    lines = [
        f"| kind | queries | answerable | {' | '.join(SHARES)} | ms |",
        f"|---|{'--:|' * (len(SHARES) + 3)}",
    ]
    groups = {answer.kind: [other for other in site_answers if other.kind == answer.kind]
              for answer in site_answers}  # fmt: skip
    for name, own in {**groups, "all": list(site_answers)}.items():
        figures = answers([answered.answer for answered in own])
        shares = " | ".join(f"{figures[key] or 0.0:.3f}" for key in SHARES.values())
        able = sum(answered.answerable for answered in own)
        ms = float(np.median([answered.answer.milliseconds for answered in own]))
        lines.append(f"| {name} | {len(own)} | {able} | {shares} | {ms:.0f} |")
    return lines


def main() -> None:
    """Answer the queries at the sites, and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m sceneprint_lab.cli.lookalike_answers", description=__doc__
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the sites (default: 1)")
    parser.add_argument("--sites", type=int, default=3, help="sites of each kind (default: 3)")
    parser.add_argument("--first", type=int, default=0, help="index of the first site (default: 0)")
    parser.add_argument("--queries", type=int, default=16, help="queries per site (default: 16)")
    parser.add_argument(
        "--kinds", nargs="+", choices=[*dict.fromkeys(KINDS + ORDINARY + SURVEYED_KINDS)],
        help="default: all ambiguous kinds of the model's sensor",
    )  # fmt: skip
    parser.add_argument("--absent", type=int, default=0, metavar="N",
                        help="instead, query N frames of other places")  # fmt: skip
    parser.add_argument(
        "--prior", nargs=2, type=float, metavar=("LEAST", "MOST"),
        help="range of the error of the robot's prior, metres (default: no prior)",
    )  # fmt: skip
    parser.add_argument("--candidates", type=int, default=10, help="size of C (default: 10)")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes (default: 1)")
    parser.add_argument("--model", default=PRESETS[0])
    parser.add_argument("--json", type=Path, help="write every answer to this file")
    options = parser.parse_args()
    supported = kinds_of(read_model(options.model))
    kinds = options.kinds or [kind for kind in supported if kind not in ORDINARY]
    if unknown := [kind for kind in kinds if kind not in supported]:
        parser.error(
            f"--kinds {unknown[0]}: for {options.model} choose from {', '.join(supported)}"
        )
    indices = range(options.first, options.first + options.sites)
    work = [(kind, index, options.queries) for index in indices for kind in kinds]
    if options.absent:
        work = [
            ("absent", options.first + i, min(ABSENT_BLOCK, options.absent - i * ABSENT_BLOCK))
            for i in range(-(-options.absent // ABSENT_BLOCK))
        ]
    start, site_answers = time.monotonic(), []
    prior = None if options.prior is None else (options.prior[0], options.prior[1])
    ask = partial(ask_site, seed=options.seed, candidates=options.candidates, prior=prior)
    answered = map_over(work, ask, partial(open_signer, options.model), options.jobs)
    for of_site in tqdm(answered, total=len(work), disable=None):
        site_answers += of_site
    print("\n".join(table(site_answers)))
    print(f"seed {options.seed}, {len(work)} sites, {time.monotonic() - start:.0f} s")
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(answer) for answer in site_answers], indent=1))


if __name__ == "__main__":
    main()
