"""Computes statistics over training seeds and their bootstrap intervals.

The statistics follow Agarwal et al., "Deep Reinforcement Learning at the Edge of the
Statistical Precipice" (2021), with SciPy: interquartile mean, percentile bootstrap, and probability
of improvement.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

LEVEL = 0.95
"""confidence level of an interval"""
RESAMPLES = 10_000
"""number of resamples of an interval"""
BAND_RESAMPLES = 2_000
"""number of resamples of each interval of a curve"""
BOOTSTRAP_SEED = 20_210_830
"""seed of the resamples of every interval"""
FEW = 5
"""number of seeds below which intervals are flagged: they are too narrow"""

Values = NDArray[np.float64]
Interval = tuple[float, float]


def iqm(values: Values, axis: int = -1) -> Any:
    """Returns the interquartile mean: the mean without the lowest and the highest quarter.

    The size of a quarter is rounded down: 1 to 3 values give the mean of all, 4 the mean of the
    middle 2, 5 the mean of the middle 3.
    """
    return stats.trim_mean(values, 0.25, axis=axis)


def iqm_difference(first: Values, second: Values, axis: int = -1) -> Any:
    """Returns the difference of two interquartile means."""
    return iqm(first, axis) - iqm(second, axis)


def probability_of_improvement(first: Values, second: Values, axis: int = -1) -> Any:
    """Returns the probability that a value of `first` is above one of `second`; ties count half."""
    a, b = np.moveaxis(first, axis, -1)[..., :, None], np.moveaxis(second, axis, -1)[..., None, :]
    return ((a > b) + 0.5 * (a == b)).mean((-2, -1))


def iqm_ratio_share(sample: Values, *others: Values, higher: bool, axis: int = -1) -> Any:
    """Returns the IQM share, x / (x + best of the others); above 0.5 is better.

    Unlike the ratio x / best, the share is finite: 1 for a ratio to 0, and 0.5 for 0 to 0. It is
    inverted if less is better.
    """
    value = iqm(sample, axis)
    rest = np.stack([iqm(other, axis) for other in others])
    best = rest.max(0) if higher else rest.min(0)
    total = value + best
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total == 0, 0.5, (value if higher else best) / total)


def as_ratio(share: float) -> float:
    """Returns the ratio x / y of a share x / (x + y); infinite for 1."""
    return share / (1 - share) if share < 1 else float("inf")


def ratio_to_best(*samples: Values, higher: bool) -> tuple[float, Interval | None]:
    """Returns the ratio of the first IQM to the best other, above 1 if better, and its interval.

    `samples` are [seeds, fires] for each method.
    """
    share = partial(iqm_ratio_share, higher=higher)
    ends = crossed_interval(share, *samples)
    now = float(share(*(sample.mean(1) for sample in samples)))
    return as_ratio(now), ends and (as_ratio(ends[0]), as_ratio(ends[1]))


def curve_interval(curves: Values) -> Any:
    """Returns both ends of the 95 % percentile bootstrap interval of the IQM of curves, [points].

    `curves` are [seeds, points]. None if there is only one, or an end is not finite.
    """
    if len(curves) < 2:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        ends = stats.bootstrap(
            [curves],
            iqm,
            axis=0,
            n_resamples=BAND_RESAMPLES,
            confidence_level=LEVEL,
            method="percentile",
            vectorized=True,
            rng=np.random.default_rng(BOOTSTRAP_SEED),
        ).confidence_interval
    return _finite(ends)


def crossed_interval(
    statistic: Callable[..., Any], *samples: Values, seeds: bool = True
) -> Interval | None:
    """Returns the 95 % interval of a statistic of trainings, over their seeds and the fires.

    `samples` are [seeds, fires] for each training. Each resample draws fires, the same for all, and
    seeds within each; a run's number is its mean over the drawn fires. This interval describes
    another training on other fires; without `seeds`, where only fires are drawn, the networks.
    None if there is only one fire or, for `seeds`, one seed, or an end is not finite.
    """
    if min(sample.shape[not seeds] for sample in samples) < 2:
        return None
    tail = (1 - LEVEL) / 2
    return _finite(np.quantile(_crossed(statistic, samples, seeds), [tail, 1 - tail]))


def crossed_p(statistic: Callable[..., Any], *samples: Values) -> float | None:
    """Returns the two-sided p-value of a statistic being 0, of the resamples of the interval."""
    if min(map(len, samples)) < 2:
        return None
    resampled = _crossed(statistic, samples)
    beyond = min((resampled <= 0).sum(), (resampled >= 0).sum())
    return float(min(1.0, 2 * (beyond + 1) / (len(resampled) + 1)))


def holm(values: Sequence[float]) -> list[float]:
    """Returns p-values that are corrected for their number (Holm 1979)."""
    p = np.asarray(values, float)
    order = p.argsort()
    factors = np.arange(len(p), 0, -1)
    corrected = np.empty_like(p)
    corrected[order] = np.maximum.accumulate(p[order] * factors).clip(max=1.0)
    return corrected.tolist()


def _crossed(
    statistic: Callable[..., Any], samples: Sequence[Values], seeds: bool = True
) -> Values:
    """Returns a statistic of resamples of fires and, if wanted, seeds, see `crossed_interval`."""
    share, state = _drawn_fires(samples[0].shape[1], RESAMPLES)
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    generator.bit_generator.state = state
    drawn: list[Values] = []
    for sample in samples:
        drawn.append(sample @ share)
        if seeds:
            rows = generator.integers(len(sample), size=(len(sample), RESAMPLES))
            drawn[-1] = np.take_along_axis(drawn[-1], rows, axis=0)
    return statistic(*drawn, axis=0)


@lru_cache(4)
def _drawn_fires(fires: int, resamples: int) -> tuple[Values, Any]:
    """Returns the share of each fire in resamples, and the generator's state afterwards."""
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    share = generator.multinomial(fires, [1 / fires] * fires, resamples).T / fires
    return share, generator.bit_generator.state


def _finite(ends: Any) -> Any:
    return tuple(np.asarray(ends).tolist()) if np.isfinite(ends).all() else None
