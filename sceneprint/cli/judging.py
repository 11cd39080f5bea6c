"""Options of the commands that judge transforms: how they are found, and when they are believed."""

from __future__ import annotations

import argparse


def add_judging_options(command: argparse.ArgumentParser) -> None:
    """`--mode` and `--matching`."""
    command.add_argument(
        "--mode",
        choices=("full", "paper"),
        default="full",
        help="accept on all evidence, or as the paper on the residual alone (default: full)",
    )
    command.add_argument(
        "--matching",
        choices=("histograms", "sequence"),
        default="histograms",
        help="find correspondences by histograms, or as the paper by aligned sequences of "
        "neighbours, which is slower (default: histograms)",
    )
