"""Tests of rate bounds against SciPy and their definition, and of curves against counts."""

import numpy as np
import pytest

from sceneprint_lab.evaluation.measures import roc, upper_bound


@pytest.mark.parametrize(("seen", "of"), [(0, 2000), (3, 40), (9, 10)])
def test_the_bound_is_that_of_clopper_and_pearson(seen, of):
    from scipy.stats import beta, binom  # slow to import

    bound = upper_bound(seen, of)
    assert bound == pytest.approx(beta.ppf(0.95, seen + 1, of - seen), rel=1e-9)
    # what it means: so few are seen with a chance of 5 % there, and with less above
    assert binom.cdf(seen, of, bound) == pytest.approx(0.05, rel=1e-6)


def test_a_curve_by_hand():
    right = np.array([True, True, False, True, False])
    curve = roc(np.array([5.0, 4.0, 3.0, 3.0, 1.0]), right)
    np.testing.assert_allclose(curve.true, [0, 1 / 3, 2 / 3, 1, 1])
    np.testing.assert_allclose(curve.false, [0, 0, 0, 1 / 2, 1])
    np.testing.assert_array_equal(curve.thresholds, [np.inf, 5, 4, 3, 1])
    assert curve.area == pytest.approx((2 + 2 + 1.5) / 6)  # of six couples one is a tie
    assert [curve.true_at(share) for share in (0.0, 0.49, 0.5)] == [2 / 3, 2 / 3, 1.0]
    assert curve.thinned() == [
        [0.0, 0.0, np.inf], [0.0, 1 / 3, 5.0], [0.0, 2 / 3, 4.0], [0.5, 1.0, 3.0], [1.0, 1.0, 1.0]
    ]  # fmt: skip
