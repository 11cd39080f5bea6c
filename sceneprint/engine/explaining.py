"""Why each frame of a ranking came as far as it did.

Found, Validated  --explain-->  Explanations
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sceneprint.engine.telling import Found, tell_validation
from sceneprint.engine.validating import NOT_ASKED, Validated
from sceneprint.geometry.diversity import DUPLICATE, DiversityParameters, remaining
from sceneprint.geometry.retrieval import Ints64
from sceneprint.schemas import Explanation, Validation
from sceneprint.schemas.explanations import Outcome
from sceneprint.schemas.options import Stage


def explain(
    found: Found, tried: Validated, among: Ints64 | None, p: DiversityParameters | None
) -> list[Explanation]:
    """How far each frame of R came, and why.

    Parameters
    ----------
    found : with the rows of all of R
    tried : what came of the candidates
    among : (R, R) distances within R; None where diversification was not asked for
    p : that the selection was made with
    """
    left = None
    if among is not None and len(found.ranking):
        left = remaining(among, np.asarray(tried.chosen, np.intp), p)
    told = {match.index: tell_validation(match.validation) for match in tried.matches}
    return list(_each(found, tried, told, among, left))


def figures(v: Validation) -> str:
    """What a validation found, in one line: its reason, and the numbers it rests on."""
    if v.residual is None:
        return f"{v.status}: {v.reason}"
    return (
        f"{v.status}: {v.reason} (the directions disagree by {v.residual.translation_m:.3g} m, "
        f"{v.residual.rotation_deg:.3g} deg; overlap {v.overlap:.3g}, by planes "
        f"{v.plane_overlap:.3g}; violations {_or_unknown(v.free_space_violations)}; ambiguity "
        f"{v.ambiguity:.3g})"
    )


def _or_unknown(share: float | None) -> str:
    return "unknown" if share is None else f"{share:.3g}"


def _each(
    found: Found, tried: Validated, told: dict[int, Validation], among: Ints64 | None,
    left: np.ndarray | None,
) -> Iterator[Explanation]:  # fmt: skip
    chosen = set(tried.chosen)
    for position, number in enumerate(found.ranking.indices.tolist()):
        if number not in found.rows:  # deleted in the meantime
            continue
        stage: Stage = "retrieve"
        outcome: Outcome = "not_selected"
        if number in told:
            stage, outcome = "validate", told[number].status
            reason = figures(told[number])
        elif position in chosen:
            stage = "retrieve" if found.selection is None else "diversify"
            asked = tried.untried != NOT_ASKED
            outcome = "skipped" if asked else "ranked"
            reason = tried.unreadable.get(number, tried.untried)
        elif among is not None and left is not None:
            reason = _not_selected(found, tried, among, position, float(left[position]))
        else:
            reason = f"beyond the first {len(chosen)} of the ranking, which were the candidates"
        yield Explanation(
            frame_id=found.rows[number].id,
            map=found.maps[found.rows[number].map_number],
            rank=position + 1,
            distance=int(found.ranking.distances[position]),
            similarity=float(found.ranking.similarities[position]),
            stage=stage,
            outcome=outcome,
            reason=reason,
        )


def _not_selected(found: Found, tried: Validated, among: Ints64, position: int, gain: float) -> str:
    """Whom of the selection it is like, and what it would have brought."""
    own = among[position, list(tried.chosen)]
    nearest = tried.chosen[int(np.argmin(own))]
    row = found.rows.get(int(found.ranking.indices[nearest]))
    name = "one that was deleted since" if row is None else f"frame {row.id}"
    if gain <= DUPLICATE:
        return f"a duplicate of {name} of the selection"
    return (
        f"most like {name} of the selection (distance {int(own.min())}); it would bring a gain of "
        f"{gain:.2g} to it"
    )
