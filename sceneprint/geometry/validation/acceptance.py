"""Sec. III-E, acceptance: what is known of a transform to whether it is believed.

Evidence  --objection-->  why not        Evidence, ambiguity  --belief-->  how far
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Status = Literal["accepted", "ambiguous", "rejected"]
Strength = Literal["strong", "weak"]
Mode = Literal["full", "paper"]


@dataclass(frozen=True)
class AcceptanceParameters:
    """The numbers of acceptance; how they were chosen: docs/evaluation.md."""

    residual_m: float = 0.08  #: of the two directions composed: epsilon_val of Sec. III-E
    residual_rad: float = math.radians(5.0)
    violation_weight: float = 5.0  #: evidence = overlap - this x violations
    evidence: float = 0.2  #: least
    plane_overlap: float = 0.15  #: least
    net_weight: float = 3.0  #: net plane overlap = plane overlap - this x violations
    net: float = 0.1  #: least of it
    net_strong: float = 0.1  #: of it, below which an accepted match is weak
    planes: float = 0.0  #: least number of distinct planes that agree
    plane_violations: float = 1.0  #: most, by planes
    worst_violations: float = 0.05  #: most, in the worse of the two directions
    strong: float = 0.3  #: evidence below which an accepted match is weak
    weak: float = 0.05  #: ambiguity from which on an accepted match is weak
    ambiguous: float = 0.14  #: ambiguity from which on nothing is accepted
    ambiguous_share: float = 0.5  #: nor from this share of `plane_overlap` on
    stiffness: float = 1e-5  #: least ratio of the eigenvalues of the information
    blind_evidence: float = 0.4  #: least where nothing is known of free space
    blind_plane_overlap: float = 0.3  #: and least of `plane_overlap`
    blind_ambiguous_share: float = 0.75  #: of which, in the place of both above: fewer rivals fall


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against a transform, before rivals are looked for.

    Parameters
    ----------
    residual_m, residual_rad, overlap, plane_overlap : as in Validation
    violations : as in Validation; None where there is no evidence of free space
    stiffness : the less of both directions', as in Alignment
    one_sided : free space of one of the frames is not known
    planes : how many distinct planes agree, the mean of both frames
    plane_violations : free-space violations with every plane counting the same, as a share of
        what agrees or violates
    worst_violations : violations of the frame that violates more, as a share of its own
    """

    residual_m: float
    residual_rad: float
    overlap: float
    plane_overlap: float
    violations: float | None
    stiffness: float
    one_sided: bool = False
    planes: float = math.inf
    plane_violations: float = 0.0
    worst_violations: float = 0.0

    def total(self, p: AcceptanceParameters) -> float:
        """For less against."""
        return self.overlap - p.violation_weight * (self.violations or 0.0)

    def net(self, p: AcceptanceParameters) -> float:
        """For less against, by planes."""
        return self.plane_overlap - p.net_weight * (self.violations or 0.0)


def objection(e: Evidence, p: AcceptanceParameters, mode: Mode) -> tuple[Status, str] | None:
    """Why not to accept, whatever the rivals: Sec. III-E. None where nothing speaks against it.

    Parameters
    ----------
    e : see Evidence
    p : see AcceptanceParameters
    mode : "paper" asks for the residual alone
    """
    if e.residual_m > p.residual_m or e.residual_rad > p.residual_rad:
        if not math.isfinite(e.residual_m):
            return "rejected", "only one of the two directions found a transform"
        metres, degrees = _two_digits(e.residual_m), _two_digits(math.degrees(e.residual_rad))
        return "rejected", f"the two directions disagree by {metres} m, {degrees} deg"
    if mode == "paper":
        return None
    blind = e.violations is None
    evidence = p.blind_evidence if blind else p.evidence
    if e.total(p) < evidence:
        if e.violations is None:
            return "rejected", f"only {e.overlap:.0%} agrees, and free space is not known"
        if e.overlap < evidence:
            return "rejected", f"only {e.overlap:.0%} of the surfaces agree"
        return "rejected", f"{e.violations:.1%} lies where the other frame saw through"
    if e.plane_overlap < (p.blind_plane_overlap if blind else p.plane_overlap):
        return "rejected", f"what agrees is mostly one plane ({e.plane_overlap:.0%} by planes)"
    if e.net(p) < p.net:
        return "rejected", (
            f"{e.plane_overlap:.0%} agrees by planes, and {e.violations or 0.0:.1%} lies where the "
            "other frame saw through"
        )
    if e.plane_violations > p.plane_violations or e.worst_violations > p.worst_violations:
        share = max(e.plane_violations, e.worst_violations)
        return "rejected", f"{share:.1%} lies where the other frame saw through"
    if e.planes < p.planes:
        return "ambiguous", (
            f"only {e.planes:.0f} distinct planes agree, too few to tell corridors apart"
        )
    if e.stiffness < p.stiffness:
        return "ambiguous", "what the frames share leaves a direction free, as a plane does"
    return None


def belief(
    e: Evidence, ambiguity: float, p: AcceptanceParameters
) -> tuple[Status, Strength | None, str]:
    """How far to believe a transform that nothing but its rivals speaks against."""
    most = min(p.ambiguous, p.ambiguous_share * e.plane_overlap)
    if e.violations is None:  # no rival is refuted by free space either
        most = p.blind_ambiguous_share * e.plane_overlap
    if ambiguity >= most:
        return "ambiguous", None, "another transform explains the frames as well"
    if e.violations is None:
        return "accepted", "weak", "surfaces agree, but nothing is known of free space"
    if ambiguity >= p.weak:
        return "accepted", "weak", "another transform is not ruled out"
    if e.total(p) < p.strong or e.net(p) < p.net_strong:
        return "accepted", "weak", f"{e.overlap:.0%} of the surfaces agree"
    if e.one_sided:  # what one frame has and the other lacks may speak against it unheard
        return "accepted", "weak", "surfaces agree, but free space is known of one frame only"
    return "accepted", "strong", "surfaces agree, and nothing speaks against it"


def _two_digits(value: float) -> str:
    """As people write it: 130, and never 1.3e+02."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
