"""Adds the actions of a scripted teacher, made from each UAV's belief map, to an environment."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from emberlink.comm._belief import BeliefMaps
from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.policies.scripted.map_greedy import MapGreedy


class KnownMaps:
    """Shows the UAVs' own maps in the form that scripted policies read.

    A UAV also knows the targets of the UAVs that it hears, unless messages are late. Such a target
    may depend on cells that it receives one step later, or never with `env.radio.bandwidth`.

    Args:
        maps: the maps of the environment's communication.
    """

    reach: Tensor

    def __init__(self, maps: BeliefMaps):
        self._maps = maps

    def update(self, tensordict: TensorDictBase) -> None:
        """Reads the maps, which are updated already, and the links of a time step, if any."""
        nobody = torch.zeros_like(self._maps.stamp, dtype=torch.bool)
        late = self._maps.world.radio.delay > 0
        self.reach = nobody if late else tensordict.get(keys.HEARS, nobody)
        self._last, self._state = self._maps.sightings()

    @property
    def heard(self) -> Tensor:
        """The step of the latest news that each UAV (row) has of another one, [envs, n, n]."""
        return self._maps.stamp.clamp(min=0)

    def last_seen(self) -> Tensor:
        """Returns the last step at which each UAV knows each cell seen, float [envs, n, X, Y]."""
        return self._last.float()

    def was_fire(self, last_seen: Tensor) -> tuple[Tensor, Tensor]:
        """Returns whether cells had ignited and had burnt out when they were last seen."""
        return (self._state == 1) | (self._state == 2), self._state == 2


class Teacher(Transform):
    """Writes the actions of a scripted policy under `keys.TEACHER`, made from the maps of the UAVs.

    It is added after the communication. Each UAV's action depends on its own map and on the targets
    of the UAVs that it hears (see `KnownMaps`). The environment does not change. An action flies
    towards the target at full speed, or reaches it at the end of the steps for which it is held.
    With held actions, which the environment holds, targets are chosen at each decision, else as
    often as the policy chooses them.

    Args:
        env: the environment without transforms.
        maps: the maps of its communication; None if the UAVs have none.
        name: `map_greedy`, or a policy that inherits from it.
        hold: steps for which an action is held.

    Raises:
        UserError: the UAVs have no maps, or there is no such teacher.
    """

    target: Tensor
    """float32 [num_envs, n, 2]: targets of the UAVs, cells"""

    def __init__(self, env: WildfireEnv, maps: BeliefMaps | None, name: str, hold: int):
        super().__init__()
        if maps is None:
            raise UserError(
                f"env.observation={env.config.observation}: the teacher of learner=imitation flies "
                "by the UAVs' maps, which they have with env.observation=map"
            )
        policy = find(name)(env, KnownMaps(maps))
        policy.stride *= hold
        policy.period = hold if hold > 1 else policy.period
        self._policy = (policy,)  # not registered: it has no state but the targets
        target = torch.zeros(env.num_envs, env.n_agents, 2, dtype=torch.float32)
        self.register_buffer("target", target)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._teach(tensordict_reset, tensordict.get("_reset", None))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._teach(next_tensordict, None)

    def _teach(self, tensordict: TensorDictBase, began: Tensor | None) -> TensorDictBase:
        """Writes the actions; the targets change where episodes began, everywhere if None."""
        (policy,) = self._policy
        given: Any = tensordict.select(*policy.in_keys, keys.HEARS, strict=False)
        acted = policy(given.set(policy.TARGET, self.target.clone()))
        target = acted.get(policy.TARGET)
        if began is not None:
            target = torch.where(began.view(-1, 1, 1), target, self.target)
        self.target.copy_(target)
        return tensordict.set(keys.TEACHER, acted.get(keys.ACTION))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        spec: Any = observation_spec.clone()
        shape = spec[keys.POSITION].shape
        spec[keys.TEACHER] = Unbounded(shape, device=spec.device, dtype=torch.float32)
        return spec


def find(name: str) -> type[MapGreedy]:
    """Returns the scripted policy of a name, which plans by the maps that UAVs share in range.

    Raises:
        UserError: no scripted policy has this name, or it plans otherwise.
    """
    policy = SCRIPTED.find(name, "learner.teacher")
    if not issubclass(policy, MapGreedy) or not policy.hears:
        raise UserError(
            f"learner.teacher={name}: does not plan by the maps that UAVs share in range, as "
            "map_greedy does"
        )
    return policy
