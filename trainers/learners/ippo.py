"""IPPO: PPO for each UAV, whose critic reads what the UAV observes (de Witt et al. 2020)."""

from typing import Any

import torch
from pydantic.dataclasses import dataclass
from tensordict.nn import TensorDictModule

from emberlink.envs import keys
from emberlink.policies.networks.sequence import SequenceNetwork
from emberlink.trainers.learners.base import STRICT, LearnerContext
from emberlink.trainers.learners.on_policy import OnPolicyConfig, OnPolicyLearner
from emberlink.trainers.learners.on_policy.proximal import VALUE


@dataclass(frozen=True, kw_only=True, config=STRICT)
class IPPOConfig(OnPolicyConfig):
    """Stores the settings of IPPO."""


class IPPO(OnPolicyLearner):
    """Values what each UAV observes."""

    config_type = IPPOConfig

    def make_critic(
        self, context: LearnerContext, generators: list[torch.Generator]
    ) -> TensorDictModule:
        spec, config = context.observation_spec, self.config
        network = SequenceNetwork(
            context.num_uavs,
            keys.observation_shapes(spec),
            1,
            config.hidden,
            policy=context.policy,
            gain=1.0,
            share_parameters=config.share_parameters,
            device=context.device,
            generator=generators,
        )
        observed: list[Any] = keys.observation_keys(spec)
        return TensorDictModule(network, in_keys=observed, out_keys=[VALUE])
