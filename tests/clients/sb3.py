"""Trains Stable-Baselines3's PPO on the team as one agent, and scores it on the test fires."""

import gymnasium
from stable_baselines3 import PPO

from emberlink.trainers import evaluate, make_env

WORLD = {"setup": "strong", "memory": "none", "hold": 1, "num_uavs": 3, "horizon": 100}
env = gymnasium.make(
    "emberlink.envs.gymnasium:emberlink/WildfireTeam-v0",
    env=make_env("independent", fire="huygens", seed=0, **WORLD),
)
model = PPO("MlpPolicy", env, n_steps=1000, batch_size=250, gamma=0.9, seed=0, device="cpu")


def act(observation):
    """Returns the team's actions, [B, 3, 3], for [B, 3, 6]."""
    flat = observation.reshape(len(observation), -1)
    return model.predict(flat, deterministic=True)[0].reshape(-1, 3, 3)


settings = {**WORLD, "scripted": False}
before = evaluate(act, "independent", episodes=20, **settings)["huygens"]["learned"]
model.learn(30_000)
after = evaluate(act, "independent", episodes=20, name="sb3_ppo", **settings)["huygens"]["learned"]
coverage = [sum(one["coverage"]) / 20 for one in (before, after)]
print(f"coverage before and after: {coverage[0]:.1f}, {coverage[1]:.1f} %")
assert coverage[1] > coverage[0]
