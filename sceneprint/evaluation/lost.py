"""Where queries are lost on their way from the database to an accepted match.

Outcome, ...  --lost-->  counts
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from sceneprint.evaluation.measures import OVERLAPS
from sceneprint.evaluation.records import Outcome

#: Every query ends in exactly one of these.
PLACES = (
    "found",
    "near",
    "wrongly_accepted",
    "nothing_overlaps",
    "not_in_r",
    "not_in_c",
    "ambiguous",
    "rejected",
)


def lost(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Count the queries by where VDR lost them; the counts add up to the queries.

    See `place_of` for what each word means.
    """
    counts = Counter(place_of(outcome) for outcome in outcomes)
    return {place: counts[place] for place in PLACES}


def place_of(outcome: Outcome) -> str:
    """The first of these that is true of a query.

    With an accepted match: `found`, VDR's answer is right to 10 cm and 10 degrees; `near`, to
    20 cm and 20 degrees; else `wrongly_accepted`. Without one: `nothing_overlaps`, no database
    frame overlaps the query by 30 % (smaller direction, within 10 cm), which holds for every
    query of an absent scene; `not_in_r`, such frames are not in R; `not_in_c`, those in R are
    not in C; `ambiguous`, one of those in C was ambiguous; else `rejected`.
    """
    answers = outcome.views("VDR")
    if answers:
        error = answers[0].error
        if error.within(0.10, 10):
            return "found"
        return "near" if error.within(0.20, 20) else "wrongly_accepted"
    good = set(outcome.allowed[outcome.overlap_least >= OVERLAPS].tolist())
    if not good:
        return "nothing_overlaps"
    if not good & set(outcome.ranking):
        return "not_in_r"
    selected = good & set(outcome.selection)
    if not selected:
        return "not_in_c"
    states = {outcome.pairs[match].validation.status for match in selected}
    return "ambiguous" if "ambiguous" in states else "rejected"
