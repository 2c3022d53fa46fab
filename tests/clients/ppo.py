"""Trains a PPO of one file and plain PyTorch, with shared weights, and scores it."""

import torch
from torch import nn
from torch.distributions import Normal

from emberlink.envs import WildfireConfig, WildfireEnv, keys
from emberlink.envs.config import RewardConfig
from emberlink.trainers import evaluate

WORLD = {"num_uavs": 3, "horizon": 100}
ENVS, STEPS, HOLD, ITERATIONS = 64, 10, 10, 100
torch.manual_seed(0)
reward = RewardConfig(
    new_fire=1.0, old_fire=0.0, no_fire=0.0, unseen=-0.03, exit=-1.5, exit_axes="xy"
)
config = WildfireConfig(observation_scale="box", reward=reward, **WORLD)
env = WildfireEnv(ENVS, config, "huygens", seed=0, hold=HOLD)
actor = nn.Sequential(nn.Linear(6, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 3))
critic = nn.Sequential(nn.Linear(6, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))
log_std = nn.Parameter(torch.full((3,), -0.5))
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], lr=1e-3)


def act(observation):
    """Returns the means of the actions for an array [B, n, 6]."""
    with torch.no_grad():
        return actor(torch.as_tensor(observation)).numpy()


def score(**more):
    settings = {**WORLD, "observation_scale": "box", "setup": "tuned", "scripted": False}
    found = evaluate(act, "independent", episodes=20, **{"policy.hold": HOLD}, **settings, **more)
    return sum(found["huygens"]["learned"]["coverage"]) / 20


before = score()
for _ in range(ITERATIONS):
    td, seen, actions, rewards = env.reset(), [], [], []
    with torch.no_grad():
        for _ in range(STEPS):
            x = td[keys.OBSERVATION]
            action = Normal(actor(x), log_std.exp()).sample()
            after = env.step(td.set(keys.ACTION, action))["next"]
            seen.append(x)
            actions.append(action)
            rewards.append(after[keys.REWARD])
            td = after
        x, a, r = torch.stack(seen), torch.stack(actions), torch.stack(rewards)
        old = Normal(actor(x), log_std.exp()).log_prob(a).sum(-1, keepdim=True)
        returns, total = torch.empty_like(r), torch.zeros_like(r[0])
        for step in reversed(range(STEPS)):
            total = r[step] + 0.9 * total
            returns[step] = total
        advantage = returns - critic(x)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
    for _ in range(8):
        new = Normal(actor(x), log_std.exp()).log_prob(a).sum(-1, keepdim=True)
        ratio = (new - old).exp()
        clipped = ratio.clamp(0.8, 1.2)
        loss = -torch.minimum(ratio * advantage, clipped * advantage).mean()
        loss = loss + 0.5 * (critic(x) - returns).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
after = score(name="plain_ppo")
print(f"coverage before and after: {before:.1f}, {after:.1f} %")
assert after > before
