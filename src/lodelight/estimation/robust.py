"""Huber's kernel on the squared, whitened residual of a whole observation.

Source: Huber 1964; iteratively reweighted as in Zhang, "Parameter estimation techniques", 1997.
"""

import math

from lodelight.compiled import kernel


@kernel
def huber(chi2: float, bound: float) -> tuple[float, float]:
    """(cost, weight) of a squared norm: quadratic up to chi2 = bound, linear in the norm beyond."""
    if chi2 <= bound:
        return chi2, 1.0
    ratio = math.sqrt(bound / chi2)
    return 2.0 * ratio * chi2 - bound, ratio


@kernel
def dynamic_covariance(chi2: float, bound: float) -> tuple[float, float]:
    """(cost, weight) that lets go of gross errors: quadratic up to the bound, then never above 3 bound.

    Source: Agarwal et al., "Robust map optimization using dynamic covariance scaling", ICRA 2013.
    """
    if chi2 <= bound:
        return chi2, 1.0
    s = 2.0 * bound / (bound + chi2)
    return 3.0 * bound - 2.0 * bound * s, s * s  # the cost is the integral of the weight
