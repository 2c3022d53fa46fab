"""Tests that networks which read the index of a UAV learn from that UAV's transitions."""

import pytest
import torch

from emberlink.envs import keys
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

SMALL = [
    *("setup=tuned", "env.num_uavs=3", "env.horizon=12", "num_envs=2", "episodes=4"),
    *("learner.hidden=[8]", "fire.num_train_fires=1", "policy.hold=1"),
]
OFF_POLICY = ["learner.batch_size=60", "learner.share_parameters=true"]
SEQUENCES = ["policy.memory=gru", "policy.units=4", "learner.sequence=3", "learner.burn_in=2"]
MAPS = ["world=front", "env.grid=[20,20]", "comm.pixels=8", "learner=imitation"]
CASES = {
    "ddpg": ("positional", OFF_POLICY, keys.ACTION),
    "ddpg-team": ("positional", [*OFF_POLICY, "learner.critic=team"], keys.ACTION),
    "td3-gru": ("consensus", [*OFF_POLICY, "learner=td3", *SEQUENCES], keys.ACTION),
    "imitation": ("maps", [*MAPS, "learner.samples=60"], keys.TEACHER),
    "imitation-own": (
        "maps",
        [*MAPS, "learner.samples=60", "learner.share_parameters=false"],
        keys.TEACHER,
    ),
}


def actors(case: str, *more: str) -> torch.Tensor:
    """Returns which UAV acted in the transitions of a batch, [batch, (decisions,) uavs]."""
    method, settings, key = CASES[case]
    setup = TrainingSetup(resolve(method, [*SMALL, *settings, *more]))
    setup.dry_run(24)
    stored = setup.learner.replay._buffer.storage._storage
    stored[key[-1]][..., 0] = torch.arange(3.0)
    drawn = setup.learner.replay.sample()[key][..., 0]
    return drawn.movedim(drawn.shape.index(3, 1), -1)


@pytest.mark.parametrize("case", CASES)
def test_a_network_reads_the_index_of_the_uav_that_acted(case):
    drawn = actors(case, "policy.agent_index=true")
    assert drawn.equal(torch.arange(3.0).expand_as(drawn))


@pytest.mark.parametrize("case", CASES)
def test_without_an_index_uavs_learn_from_each_other(case):
    drawn = actors(case)
    assert 0.1 < (drawn == torch.arange(3.0)).float().mean() < 0.7


def test_networks_of_single_uavs_learn_from_each_other():
    """Their index is a constant."""
    drawn = actors("ddpg", "policy.agent_index=true", "learner.share_parameters=false")
    assert 0.1 < (drawn == torch.arange(3.0)).float().mean() < 0.7
