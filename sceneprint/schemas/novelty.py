"""What `if_novel` of an upload means, however it is given."""

from __future__ import annotations

from sceneprint.errors import InvalidRequest

#: Where `if_novel` is just true: consecutive frames of a slow Kinect lie nearer than this, mostly
#: by the noise of their depth, and what is left of a recording answers as well (docs/).
NOVEL = 0.25


def novelty_of(given: bool | float | str | None) -> float | None:
    """The distance beyond which a frame is kept, as a share of that of unrelated frames.

    Parameters
    ----------
    given : the share, as number or text; true for the default; false or None for every frame

    Raises
    ------
    InvalidRequest : none of these.
    """
    if given is None or given is False or given == "false":
        return None
    if given is True or given == "true":
        return NOVEL
    try:
        share = float(given)
    except (TypeError, ValueError):
        share = -1.0
    if not 0 < share <= 1:  # nor for NaN
        raise InvalidRequest(
            f"`if_novel` is {given!r:.40}. Give true, or a share of the distance of unrelated "
            "frames: above 0, up to 1.",
            (("if_novel", "neither true nor false nor a number above 0, up to 1"),),
        )
    return share
