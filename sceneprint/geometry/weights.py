"""How much a patch has to say: size and flatness to a weight, and of two patches to a pair's.

    Patches (P)  --patch_weights-->  (P,)

The paper counts every pair once. Then where the segmentation happens to cut decides how much
a surface counts, and a chair's leg, whose one patch bends round it, counts like a square of
floor. Weighting by size makes the statistics depend on the surface rather than on its cuts;
weighting by coherence keeps normals that are means of unlike normals from being believed.
"""

from __future__ import annotations

from dataclasses import dataclass

from sceneprint.types import Floats, Patches


@dataclass(frozen=True)
class WeightParameters:
    """The numbers of the weights; both 0 give the paper's equal pairs."""

    size_exponent: float = 0.5  #: of the share of the image that a patch covers
    coherence_exponent: float = 20.0  #: of the length of the mean of its pixels' normals


def patch_weights(patches: Patches, p: WeightParameters) -> Floats:
    """Weight of each patch; a pair weighs the product of its two.

    Parameters
    ----------
    patches : P of them
    p : see WeightParameters

    Returns
    -------
    weights : (P,) positive, of mean 1
    """
    weights = patches.sizes**p.size_exponent * patches.coherences**p.coherence_exponent
    result: Floats = weights / weights.mean()
    return result
