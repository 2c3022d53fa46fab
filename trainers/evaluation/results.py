"""Defines the structure of the results of an evaluation."""

from collections.abc import Mapping

import numpy as np

CURVES = {
    "mean_reward": "mean reward",
    "coverage": "coverage, %",
    "tracking_first": "first UAV on fire, step",
    "tracking_last": "last UAV on fire, step",
    "boundary_exits": "boundary exits per UAV",
    "fire_losses": "fire losses per UAV",
}
"""measure -> axis label, in the order of the paper's figures 5 to 9"""


Measured = dict[str, list[float]]
"""measure -> one number per episode"""


LEARNED = "learned"
"""name of the learned policy in results"""


Results = dict[str, dict[str, Measured]]
"""fire -> policy -> measure -> one number per episode"""


def means(measured: Mapping[str, list[float]]) -> dict[str, float]:
    """Returns the mean over episodes of each measure."""
    return {name: float(np.mean(values)) for name, values in measured.items()}


def learned_means(results: Results) -> dict[str, float]:
    """Returns "test/fire/measure" -> mean over episodes of the learned policy."""
    return {
        f"test/{fire}/{name}": value
        for fire, by_policy in results.items()
        for name, value in means(by_policy[LEARNED]).items()
    }
