"""The form of an evaluation's results."""

CURVES = {
    "mean_reward": "score (mean reward)",
    "coverage": "coverage, %",
    "tracking_first": "first UAV on fire, step",
    "tracking_last": "last UAV on fire, step",
    "boundary_exits": "boundary exits per UAV",
    "fire_losses": "fire exits per UAV",
}
"""measure -> axis label, in the order of the paper's figures 5 to 9"""


Measured = dict[str, list[float]]
"""measure -> one number per episode"""


LEARNED = "learned"


Results = dict[str, dict[str, Measured]]
"""fire -> policy -> measure -> one number per episode"""
