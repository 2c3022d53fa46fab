"""Tests the replay buffer: sampling per UAV, capacity and contents."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded

from emberlink.envs import keys
from emberlink.trainers import make_env
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.nan_guard import NonFiniteGuard
from emberlink.trainers.learners.off_policy.replay_buffer import (
    DONE,
    TERMINATED,
    ReplayMemory,
    to_rows,
)

UAVS = 4


def memory(*, shared: bool, capacity: int = 4000, batch: int = 64, most: int = 10**9, uavs=UAVS):
    spec = Composite({keys.OBSERVATION: Unbounded((1, uavs, 2))}, shape=(1,))
    context = LearnerContext(
        observation_spec=spec,
        action_spec=spec,
        num_uavs=uavs,
        num_envs=1,
        seeds=(0,),
        shared_replay=shared,
        total_steps=most,
        guard=NonFiniteGuard("cpu"),
        device="cpu",
    )
    return ReplayMemory(context, batch_size=batch, buffer_size=capacity)


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
    return torch.cat([buffer.sample()[keys.OBSERVATION] for _ in range(samples)]).long()


def test_private_memory_samples_transitions_of_the_same_uav():
    buffer = memory(shared=False)
    buffer.extend_rows(labelled(0, 50))
    sample = drawn(buffer, 40)
    assert sample.shape == (40 * 64, UAVS, 2)
    assert (sample[..., 1] == torch.arange(UAVS)).all()
    counts = torch.stack([sample[:, k, 0].bincount(minlength=50) for k in range(UAVS)])
    assert counts.min() > 25  # 51 expected
    assert counts.max() < 85


def test_shared_memory_samples_all_uavs_equally():
    buffer = memory(shared=True)
    buffer.extend_rows(labelled(0, 50))
    sample = drawn(buffer, 200)
    for reader in range(UAVS):
        whose = sample[:, reader, 1].bincount(minlength=UAVS) / len(sample)
        torch.testing.assert_close(whose, torch.full((UAVS,), 1 / UAVS), atol=0.02, rtol=0)
        counts = (sample[:, reader, 0] * UAVS + sample[:, reader, 1]).bincount(minlength=50 * UAVS)
        assert counts.min() > 30  # 64 expected
        assert counts.max() < 105


@pytest.mark.parametrize("shared", [False, True])
def test_uavs_sample_independently(shared):
    buffer = memory(shared=shared)
    buffer.extend_rows(labelled(0, 1000))
    rows = drawn(buffer, 1)[..., 0]
    for other in range(1, UAVS):
        assert (rows[:, 0] == rows[:, other]).float().mean() < 0.1
    assert not rows.equal(drawn(buffer, 1)[..., 0])


@pytest.mark.parametrize("shared", [False, True])
def test_samples_are_stored_transitions(shared):
    buffer = memory(shared=shared)
    buffer.extend_rows(labelled(0, 300))
    sample = buffer.sample()
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
        buffer.extend_rows(labelled(first, 5))
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
    rows = to_rows(rollout, 1, [keys.OBSERVATION])
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


@pytest.mark.parametrize("shared", [False, True])
def test_memory_of_a_million_transitions(shared):
    """A transition has two observations, action, reward and two flags."""
    buffer = memory(shared=shared, capacity=1_000_000, uavs=6)
    row = to_rows(make_env("consensus", horizon=2).rollout(1), 1, [keys.OBSERVATION])
    buffer.extend_rows(row)
    transitions = 1_000_002 if shared else 6_000_000  # rows of six
    assert len(buffer._buffer.storage._storage) * 6 == transitions
    numbers = 4 * (9 + 9 + 3 + 1) * transitions
    assert buffer._buffer.storage._storage.bytes() <= 1.2 * numbers


def test_several_tensors_of_any_shape_are_stored():
    """Stores a vector and a window of bits, for two seeds of two environments."""
    observation, window = (keys.AGENTS, "observation"), (keys.AGENTS, "window")
    agents = {
        "observation": torch.rand(4, 3, UAVS, 6),
        "window": torch.rand(4, 3, UAVS, 3, 5, 5) < 0.5,
        "action": torch.rand(4, 3, UAVS, 3),
    }
    following = {
        keys.AGENTS: {name: agents[name].clone() for name in ("observation", "window")}
        | {"reward": torch.rand(4, 3, UAVS, 1)},
        "done": torch.zeros(4, 3, 1, dtype=torch.bool),
        "terminated": torch.zeros(4, 3, 1, dtype=torch.bool),
    }
    rollout = TensorDict({keys.AGENTS: agents, "next": following}, batch_size=[4, 3])
    rows = to_rows(rollout, 2, [observation, window])
    assert rows["window"].shape == (6, 2 * UAVS, 3, 5, 5)
    assert rows["window"].dtype == torch.bool
    # Row 4 is the second environment's second step; the second seed's UAVs come last.
    assert rows["window"][4, UAVS:].equal(agents["window"][3, 1])
    assert rows["next", "window"][4, :UAVS].equal(agents["window"][1, 1])
    assert rows["next", "reward"][2].equal(
        torch.cat([following[keys.AGENTS]["reward"][seed, 2] for seed in (0, 2)])
    )


@pytest.mark.parametrize("written", [20, 40, 55])
def test_a_restored_memory_samples_like_the_saved_one(written):
    def filled(rows: int) -> ReplayMemory:
        buffer = memory(shared=False, capacity=40, batch=10)
        for first in range(rows):
            buffer.extend_rows(labelled(first, 1))
        return buffer

    saved, restored = filled(written), memory(shared=False, capacity=40, batch=10)
    saved.sample()
    restored.load_state_dict({name: value.clone() for name, value in saved.state_dict().items()})
    for buffer in (saved, restored):
        for first in range(written, written + 15):
            buffer.extend_rows(labelled(first, 1))
    assert (saved.sample() == restored.sample()).all()
    assert len(saved) == len(restored)
