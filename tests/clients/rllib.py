"""Trains RLlib's PPO on UAVs that share weights, and scores it on the test fires."""

import numpy as np
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from emberlink.envs.pettingzoo import parallel_env
from emberlink.trainers import evaluate, make_env

WORLD = {"setup": "strong", "memory": "none", "hold": 1, "num_uavs": 3, "horizon": 100}


def make(_):
    return ParallelPettingZooEnv(parallel_env(make_env("independent", fire="huygens", **WORLD)))


register_env("wildfire", make)
config = PPOConfig().environment("wildfire").debugging(seed=0).env_runners(num_env_runners=0)
config = config.multi_agent(policies={"uav"}, policy_mapping_fn=lambda *_: "uav")
config = config.training(gamma=0.9, lr=1e-3, train_batch_size_per_learner=500, num_epochs=5)
algorithm = config.build_algo()
module = algorithm.get_module("uav")


def act(observation):
    """Returns the actions, [B, 3, 3], for [B, 3, 6]."""
    read = torch.as_tensor(observation).flatten(0, 1)
    with torch.no_grad():
        inputs = module.forward_inference({Columns.OBS: read})[Columns.ACTION_DIST_INPUTS]
    return np.clip(inputs[..., :3].reshape((*observation.shape[:2], 3)).numpy(), -1, 1)


settings = {**WORLD, "scripted": False}
before = evaluate(act, "independent", episodes=20, **settings)["huygens"]["learned"]
for _ in range(6):
    algorithm.train()
after = evaluate(act, "independent", episodes=20, name="rllib_ppo", **settings)["huygens"][
    "learned"
]
coverage = [sum(one["coverage"]) / 20 for one in (before, after)]
print(f"coverage before and after: {coverage[0]:.1f}, {coverage[1]:.1f} %")
assert coverage[1] > coverage[0]
