"""Checks that the actions of an episode are finite."""

from torch import Tensor

from emberlink.envs.utils.errors import UserError


class NonFiniteActionError(UserError):
    """Reports the first action of an episode that is NaN or infinite."""

    def __init__(self, value: str, uav: int, environment: int, step: int):
        super().__init__(
            f"the policy's action is {value} for UAV {uav} of environment {environment} at step "
            f"{step}; expected finite numbers"
        )
        self.value, self.uav, self.environment = value, uav, environment


def check_finite(actions: Tensor) -> None:
    """Checks the actions of an episode, float32 [horizon, num_envs, n, 3].

    Raises:
        NonFiniteActionError: a number is NaN or infinite.
    """
    wrong = ~actions.isfinite()
    if wrong.any():
        step, environment, uav, axis = wrong.nonzero()[0].tolist()
        value = f"{actions[step, environment, uav, axis].item():g}"
        raise NonFiniteActionError(value, uav, environment, step + 1)
