"""The networks as TensorDict modules, built from an environment's specs."""

from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Composite
from torchrl.modules import OrnsteinUhlenbeckProcessModule, ValueOperator

from emberlink.envs import keys

from .networks import StackedActor, StackedCritic

STATE_ACTION_VALUE = (keys.AGENTS, "state_action_value")


def make_actor(
    observation: Composite,
    action: Composite,
    hidden: tuple[int, int],
    *,
    generator: torch.Generator | None = None,
) -> TensorDictModule:
    """The UAVs' actors: ("agents", "observation") -> ("agents", "action").

    Args:
        observation, action: specs of the environment, batch size [num_envs].
        hidden: sizes of the two hidden layers.
        generator: of the initial weights.
    """
    network = _stacked(StackedActor, observation, action, hidden, generator)
    return TensorDictModule(network, in_keys=[keys.OBSERVATION], out_keys=[keys.ACTION])


def make_critic(
    observation: Composite,
    action: Composite,
    hidden: tuple[int, int],
    *,
    generator: torch.Generator | None = None,
) -> ValueOperator:
    """The UAVs' critics; arguments as `make_actor`."""
    network = _stacked(StackedCritic, observation, action, hidden, generator)
    return ValueOperator(
        network, in_keys=[keys.OBSERVATION, keys.ACTION], out_keys=[STATE_ACTION_VALUE]
    )


def _stacked(
    kind: type[StackedActor] | type[StackedCritic],
    observation: Composite,
    action: Composite,
    hidden: tuple[int, int],
    generator: torch.Generator | None,
) -> StackedActor | StackedCritic:
    uavs, features = observation[keys.OBSERVATION].shape[-2:]
    device = torch.device(observation.device or "cpu")
    actions = action[keys.ACTION].shape[-1]
    return kind(uavs, features, actions, hidden, device=device, generator=generator)


def with_noise(
    actor: TensorDictModule, action: Composite, *, theta: float, sigma: float, dt: float
) -> TensorDictSequential:
    """The actor with Ornstein-Uhlenbeck noise on its actions, clipped to the action box.

    The noise starts anew with each episode (it reads "is_init", which `InitTracker` writes) and
    does not fade: the paper anneals nothing.
    """
    noise = OrnsteinUhlenbeckProcessModule(
        action.clone(),
        eps_init=1.0,
        eps_end=1.0,
        theta=theta,
        sigma=sigma,
        dt=dt,
        action_key=keys.ACTION,
        device=torch.device(action.device or "cpu"),
    )
    parts: list[Any] = [actor, noise]
    return TensorDictSequential(*parts)
