"""MAPPO: PPO whose critic reads what all UAVs of the team observe (Yu et al. 2022, NeurIPS)."""

from typing import Any

import torch
from pydantic.dataclasses import dataclass
from tensordict.nn import TensorDictModule

from emberlink.envs import keys
from emberlink.policies.networks.sequence import TeamNetwork
from emberlink.trainers.learners.base import STRICT, LearnerContext
from emberlink.trainers.learners.on_policy import OnPolicyConfig, OnPolicyLearner
from emberlink.trainers.learners.on_policy.proximal import VALUE


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MAPPOConfig(OnPolicyConfig):
    """Stores the settings of MAPPO."""

    critic_map: bool = False
    """whether the critic, in training, also reads the true map: burning cells, seen and not seen"""

    @property
    def reads_map(self) -> bool:
        return self.critic_map


class MAPPO(OnPolicyLearner):
    """Values the observations and positions of the whole team, with one number for each UAV.

    With `critic_map`, it also reads the true map, which no actor does. The critic has one set of
    weights per seed and is used in training alone.
    """

    config_type = MAPPOConfig
    config: Any

    def make_critic(
        self, context: LearnerContext, generators: list[torch.Generator]
    ) -> TensorDictModule:
        spec, world = context.observation_spec, context.world
        network = TeamNetwork(
            context.num_uavs,
            keys.observation_shapes(spec),
            world.low,
            world.high,
            hidden=self.config.hidden,
            policy=context.policy,
            gain=1.0,
            grid=world.grid if self.config.critic_map else None,
            device=context.device,
            generator=generators,
        )
        observed: list[Any] = [keys.POSITION, *keys.observation_keys(spec)]
        observed += [keys.TRUE_MAP] if self.config.critic_map else []
        return TensorDictModule(network, in_keys=observed, out_keys=[VALUE])
