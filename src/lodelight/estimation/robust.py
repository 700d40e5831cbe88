"""Robust kernels on the squared, whitened residual of a whole observation.

Source: Huber 1964; Cauchy as in Zhang, "Parameter estimation techniques", 1997, iteratively reweighted.
"""

import math

from lodelight.compiled import kernel


@kernel
def cauchy(chi2: float, bound: float) -> tuple[float, float]:
    """(cost, weight) of a squared norm: its influence grows up to chi2 = bound and fades beyond; bound inf = none.

    One wrong match close to the camera can be off by thousands of sigmas with all the leverage of its nearness; under
    Huber's kernel, whose influence never fades, it alone turned keyframes by degrees (fr1_rpy with frames dropped).
    """
    if bound == math.inf:
        return chi2, 1.0
    return bound * math.log1p(chi2 / bound), 1.0 / (1.0 + chi2 / bound)


@kernel
def fading(chi2: float, bound: float) -> tuple[float, float]:
    """(cost, weight) of a squared norm: quadratic up to chi2 = bound, its influence fading like Cauchy's beyond.

    Unlike Cauchy's own kernel it leaves what lies within the bound at full weight, so that an estimator that keeps the
    kernel on to the end knows its own covariance: 1.4 % of the information of normal noise is lost at a 95 % bound.
    """
    if chi2 <= bound:
        return chi2, 1.0
    return bound * (1.0 + math.log(chi2 / bound)), bound / chi2


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
