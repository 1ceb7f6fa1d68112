"""Tests of all lengths together: are error bars true, is there an error of scale, is one length a mistake?

All take the errors of n lengths and their covariance: what the calibration predicts and what the test itself brings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import chdtrc, chdtri, ndtr, ndtri

from implicam.dataset import Floats

LEVEL = 0.05
"""Of the tests of error bars and of scale."""
MIN_LENGTHS_JUDGED = 5
"""With fewer, nothing is said of error bars, or of a length that is unlike the others."""
SCATTER_LEVEL = 0.01
"""Where lengths scatter more than by chance so often, the uncertainty of the scale is made larger."""
MISTAKE_LEVEL = 0.001
"""A length that chance alone makes so unlike the others, in one test of so many, is taken for a mistake."""
FREE_SCALE_SD = 0.01
"""Sd of a scale error that is let go when lengths are compared with each other."""
POWER = 0.95
CLEARLY_LIKELIER = 100.0
"""A constant error of all lengths than an error of scale, before it is named."""


@dataclass(frozen=True)
class ErrorBarsTest:
    """Whether the errors of the lengths are as large as the calibration predicts.

    Attributes:
        lengths: How many.
        chi_squared: Sum of squared errors in units of what is predicted, with what they share.
        p_value: That chance alone makes errors so large.
        ratio: Error over predicted, root mean square: 1 is right.
        low: Lower end of its 95 % interval.
        high: Upper end.
    """

    lengths: int
    chi_squared: float
    p_value: float
    ratio: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """`right`, `too small`, `too large` or `cannot tell`, as of `implicam.coverage`."""
        if self.lengths < MIN_LENGTHS_JUDGED:
            return "cannot tell"
        return "too small" if self.low > 1 else "too large" if self.high < 1 else "right"


@dataclass(frozen=True)
class ScaleTest:
    """An error of scale: what is measured is `1 + value` times as long as it is.

    Attributes:
        value: The scale error found.
        sd: Its standard uncertainty, with certificate, temperature and the calibration's own scale.
        widened: By which the sd was multiplied because lengths scatter more than predicted; 1 where they do not.
    """

    value: float
    sd: float
    widened: float = 1.0

    @property
    def p_value(self) -> float:
        """That chance alone makes it so large."""
        return float(2 * ndtr(-abs(self.value) / self.sd))

    @property
    def found(self) -> bool:
        """Whether there is an error of scale, at the level of 5 %."""
        return self.p_value < LEVEL

    @property
    def interval(self) -> tuple[float, float]:
        """Where the scale error is, with 95 %."""
        half = float(ndtri(1 - LEVEL / 2)) * self.sd
        return self.value - half, self.value + half

    def power(self, scale_error: float) -> float:
        """The probability that such a test finds an error of scale.

        Args:
            scale_error: 1e-4 for 0.1 mm in 1 m.
        """
        away, z = abs(scale_error) / self.sd, float(ndtri(1 - LEVEL / 2))
        return float(ndtr(away - z) + ndtr(-away - z))

    @property
    def detectable(self) -> float:
        """The scale error that is found with 95 %."""
        return float(ndtri(1 - LEVEL / 2) + ndtri(POWER)) * self.sd


def check_error_bars(error: Floats, cov: Floats) -> ErrorBarsTest:
    """Compare errors with what is predicted.

    Args:
        error: (n,) of the lengths.
        cov: (n, n) their covariance.
    """
    n = len(error)
    chi2 = float(error @ cho_solve(cho_factor(cov), error))
    low, high = (math.sqrt(chi2 / float(chdtri(n, p))) for p in (LEVEL / 2, 1 - LEVEL / 2))
    return ErrorBarsTest(n, chi2, float(chdtrc(n, chi2)), math.sqrt(chi2 / n), low, high)


def fit_scale(error: Floats, length: Floats, cov: Floats) -> ScaleTest:
    """Fit an error of scale by generalised least squares.

    Args:
        error: (n,) of the lengths.
        length: (n,) that were calibrated.
        cov: (n, n) covariance of the errors.
    """
    factor = cho_factor(cov)
    weights = cho_solve(factor, length)
    information = float(weights @ length)
    value, freedom = float(weights @ error) / information, len(error) - 1
    rest = error - value * length
    chi2 = float(rest @ cho_solve(factor, rest))
    scatters = freedom > 0 and float(chdtrc(freedom, chi2)) < SCATTER_LEVEL
    widened = math.sqrt(chi2 / freedom) if scatters else 1.0
    return ScaleTest(value, widened / math.sqrt(information), widened)


@dataclass(frozen=True)
class ConstantError:
    """An error that all lengths have alike, whatever their size.

    Attributes:
        value: In the length unit.
        sd: Its standard uncertainty.
    """

    value: float
    sd: float


def constant_rather_than_scale(error: Floats, length: Floats, cov: Floats) -> ConstantError | None:
    """Whether one error of all lengths explains them better than one that grows with the length.

    Both are one number, fitted by generalised least squares, so their likelihoods compare directly.

    Args:
        error: (n,) of the lengths.
        length: (n,) that were calibrated.
        cov: (n, n) covariance of the errors.

    Returns:
        The constant error, where it is significant and `CLEARLY_LIKELIER` as likely as a scale error; else None.
    """
    factor = cho_factor(cov)

    def fit(pattern: Floats) -> tuple[float, float]:
        weights = cho_solve(factor, pattern)
        information = float(weights @ pattern)
        return float(weights @ error) / information, information

    (value, information), (scale, by_length) = fit(np.ones_like(error)), fit(length)
    better = value**2 * information - scale**2 * by_length  # by how much chi-squared is lower
    sd = 1 / math.sqrt(information)
    if better < 2 * math.log(CLEARLY_LIKELIER) or 2 * ndtr(-abs(value) / sd) >= LEVEL:
        return None
    return ConstantError(value, sd)


def unlike_the_others(error: Floats, length: Floats, cov: Floats) -> list[int]:
    """Which lengths differ from what the others, with their common error of scale, say of them.

    Args:
        error: (n,) of the lengths.
        length: (n,) that were calibrated.
        cov: (n, n) covariance of the errors.

    Returns:
        Their numbers; none where many are unlike, for then it is not they that are wrong.
    """
    n = len(error)
    if n < MIN_LENGTHS_JUDGED:
        return []
    total = cov + FREE_SCALE_SD**2 * np.outer(length, length)
    kept, found = np.arange(n), list[int]()
    while True:  # the worst first: a gross one makes those look wrong that share errors with it
        inverse = np.linalg.inv(total[np.ix_(kept, kept)])
        z = np.abs(inverse @ error[kept]) / np.sqrt(np.diagonal(inverse))
        worst = int(np.argmax(z))
        if 2 * ndtr(-z[worst]) >= MISTAKE_LEVEL / n:
            return sorted(found)
        if len(found) >= max(1, n // 10):
            return []
        found.append(int(kept[worst]))
        kept = np.delete(kept, worst)
