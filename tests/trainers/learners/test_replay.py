"""Tests the replay buffer: sampling per UAV, capacity and contents."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded

from emberlink.envs import keys
from emberlink.trainers import make_env
from emberlink.trainers.learners.base import LearnerContext, mean_over_batch
from emberlink.trainers.learners.replay import (
    DONE,
    TERMINATED,
    TeamReplay,
    UavSampler,
    to_batch,
    to_rows,
)

UAVS = 4


def context(*, shared: bool, most: int = 10**9, uavs=UAVS, failures=False) -> LearnerContext:
    spec = Composite({keys.OBSERVATION: Unbounded((1, uavs, 2))}, shape=(1,))
    return LearnerContext(
        observation_spec=spec,
        action_spec=spec,
        num_uavs=uavs,
        num_envs=1,
        seed=0,
        shared_replay=shared,
        total_steps=most,
        device="cpu",
        failures=failures,
    )


def memory(*, capacity: int = 4000, batch: int = 64, **about) -> TeamReplay:
    draws = torch.Generator().manual_seed(0)
    return TeamReplay(context(**about), draws, batch_size=batch, buffer_size=capacity)


def labelled(first: int, count: int, uavs: int = UAVS) -> TensorDict:
    """Returns transitions whose values encode their row and UAV."""
    row = torch.arange(first, first + count).unsqueeze(-1).expand(count, uavs)
    label = torch.stack((row, torch.arange(uavs).expand(count, uavs)), -1).float()
    flag = torch.zeros(count, uavs, 1, dtype=torch.bool)
    following = {
        "observation": label + 0.5,
        "reward": label[..., :1] * 100 + label[..., 1:],
        "done": flag,
        "terminated": flag.clone(),
    }
    return TensorDict(
        {"observation": label, "action": -label, "next": following}, batch_size=[count, uavs]
    )


def drawn(buffer, samples: int) -> torch.Tensor:
    """Returns (row, UAV) of the transitions in many samples, [draws, uavs, 2]."""
    return torch.cat([buffer.sample()["observation"] for _ in range(samples)]).long()


def test_private_memory_samples_transitions_of_the_same_uav():
    buffer = memory(shared=False)
    buffer.extend(labelled(0, 50))
    sample = drawn(buffer, 40)
    assert sample.shape == (40 * 64, UAVS, 2)
    assert (sample[..., 1] == torch.arange(UAVS)).all()
    counts = torch.stack([sample[:, k, 0].bincount(minlength=50) for k in range(UAVS)])
    assert counts.min() > 25  # 51 expected
    assert counts.max() < 85


def test_shared_memory_samples_all_uavs_equally():
    buffer = memory(shared=True)
    buffer.extend(labelled(0, 50))
    sample = drawn(buffer, 200)
    for reader in range(UAVS):
        whose = sample[:, reader, 1].bincount(minlength=UAVS) / len(sample)
        torch.testing.assert_close(whose, torch.full((UAVS,), 1 / UAVS), atol=0.02, rtol=0)
        counts = (sample[:, reader, 0] * UAVS + sample[:, reader, 1]).bincount(minlength=50 * UAVS)
        assert counts.min() > 30  # 64 expected
        assert counts.max() < 105


@pytest.mark.parametrize("shared", [False, True])
def test_samples_are_stored_transitions(shared):
    buffer = memory(shared=shared)
    buffer.extend(labelled(0, 300))
    sample = to_batch(buffer.sample())
    assert sample.batch_size == (64,)
    label, following = sample[keys.OBSERVATION], sample["next"]
    assert sample[keys.ACTION].equal(-label)
    assert following[keys.OBSERVATION].equal(label + 0.5)
    assert following[keys.REWARD].equal(label[..., :1] * 100 + label[..., 1:])
    assert following[DONE].shape == following[TERMINATED].shape == (64, UAVS, 1)


def test_capacity_counts_uav_transitions():
    million = {"capacity": 1_000_000, "uavs": 6}
    assert memory(shared=True, **million).capacity == 166_667
    assert memory(shared=False, **million).capacity == 1_000_000
    # A buffer is not larger than the run can fill.
    assert memory(shared=False, most=300, **million).capacity == 300


@pytest.mark.parametrize(("shared", "rows"), [(True, 10), (False, 40)])
def test_the_oldest_transitions_are_overwritten(shared, rows):
    buffer = memory(shared=shared, capacity=40, batch=500)
    for first in range(0, 100, 5):
        buffer.extend(labelled(first, 5))
    assert len(buffer) == rows
    assert drawn(buffer, 2)[..., 0].unique().tolist() == list(range(100 - rows, 100))


@pytest.mark.parametrize(
    ("uavs", "shared", "rows"), [(6, True, 86), (6, False, 512), (1, True, 512), (64, True, 8)]
)
def test_a_full_batch_is_counted_in_transitions(uavs, shared, rows):
    assert memory(shared=shared, batch=512, uavs=uavs).needed == rows


def test_rows_are_the_transitions_of_the_environment():
    env = make_env("consensus", num_envs=2, horizon=3, num_uavs=UAVS)
    rollout = env.rollout(3, break_when_any_done=False)
    rows = to_rows(rollout, context(shared=False))
    assert "alive" not in rows
    assert rows.batch_size == (6, UAVS)
    for at in range(6):
        step = rollout[at // 3, at % 3]
        row = rows[at]
        assert row["observation"].equal(step[keys.OBSERVATION])
        assert row["action"].equal(step[keys.ACTION])
        assert row["next", "observation"].equal(step["next", *keys.OBSERVATION])
        assert row["next", "reward"].equal(step["next", *keys.REWARD])
        # The horizon truncates the episode, without a terminal state.
        assert row["next", "done"].flatten().tolist() == [at % 3 == 2] * UAVS
        assert not row["next", "terminated"].any()


def test_rows_say_who_was_alive_after_a_step():
    env = make_env("independent", world="blackout", num_envs=2, seed=0, num_train_fires=2)
    first = env.reset()
    env.base_env._fail_step.copy_(torch.arange(12).view(2, 6))
    rollout = env.rollout(3, auto_reset=False, tensordict=first)
    rows = to_rows(rollout, context(shared=False, uavs=6, failures=True))
    assert rows["alive"].equal(rollout["next", "agents", "alive"].flatten(0, 1))
    assert not rows["alive"].all()


def test_failed_uavs_do_not_count_in_losses():
    loss = torch.tensor([[1.0, 10.0], [3.0, 20.0], [100.0, 30.0]])
    alive = torch.tensor([[True, False], [True, False], [False, False]])
    assert mean_over_batch(loss, alive).tolist() == [2, 0]
    assert mean_over_batch(loss, None).tolist() == loss.mean(0).tolist()


@pytest.mark.parametrize("shared", [False, True])
def test_a_joint_sample_has_the_same_rows_for_all_uavs(shared):
    """With a shared buffer, the columns are rolled."""
    sampler = UavSampler(4, torch.Generator().manual_seed(0), shared=shared, joint=True)
    (rows, columns), _ = sampler.sample(range(100), 300)
    assert rows.eq(rows[:, :1]).all()
    assert rows.unique().numel() > 90
    turned = (columns - torch.arange(4)) % 4
    assert turned.eq(turned[:, :1]).all()
    assert turned.unique().tolist() == ([0, 1, 2, 3] if shared else [0])
