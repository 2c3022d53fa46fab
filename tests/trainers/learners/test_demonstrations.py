"""Tests imitation by networks with a memory, from sequences of a teacher's actions."""

import pytest
import torch
from tensordict import TensorDict
from test_imitation import MEMORY, OFF_POLICY, TINY, settings
from test_sequences import UAVS, context

from emberlink.envs import keys
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.demonstrations import DemonstrationSequences
from emberlink.trainers.learners.off_policy.sequences import MISSING
from emberlink.trainers.training.setup import TrainingSetup


def test_the_actions_of_a_sequence_are_those_of_its_decisions():
    """Observations hold decision, environment and UAV, and the teacher's action repeats them."""
    envs, horizon = 2, 7
    sizes = {"batch_size": 40, "buffer_size": 60, "sequence": 3, "burn_in": 2}
    buffer = DemonstrationSequences(context(horizon, envs), **sizes)
    shape = envs, 14, UAVS
    decision = torch.arange(14).view(1, -1, 1).expand(shape)
    env, uav = torch.arange(envs).view(-1, 1, 1).expand(shape), torch.arange(UAVS).expand(shape)
    where = torch.stack((decision, env, uav), -1).float()
    agents = {keys.OBSERVATION[1]: where, keys.TEACHER[1]: where.clone()}
    buffer.extend(TensorDict({keys.AGENTS: agents}, batch_size=shape[:2]))
    batch = buffer.sample()
    observed, taught = batch[keys.OBSERVATION], batch[keys.TEACHER]
    assert observed.shape == (14, UAVS, 5, 3)
    assert taught.shape == (14, UAVS, 3, 3)
    assert taught.equal(observed[:, :, 2:])
    steps = observed[..., 0].diff(dim=-1)
    missing, alive = batch[MISSING], batch[keys.ALIVE]
    begin = torch.arange(2) >= missing.unsqueeze(-1)
    assert steps[..., :2].equal(begin.float())
    assert (steps[..., 2:][alive[..., 1:]] == 1).all()
    assert not alive.all()
    assert (observed[..., 2] == torch.arange(UAVS).view(1, -1, 1)).all()
    assert missing.unique().tolist() == [0, 1, 2]
    assert (taught[..., 0] // horizon == taught[..., :1, 0] // horizon).all()  # one episode


@pytest.mark.parametrize("actor_of", ["ippo", "ddpg"])
@pytest.mark.parametrize("memory", ["gru", "stack"])
def test_a_memory_learns_from_its_teacher(actor_of, memory):
    more = [*MEMORY, f"policy.memory={memory}", f"learner.actor_of={actor_of}", "learner.lr=0.003"]
    setup = TrainingSetup(resolve("maps", settings("imitation", *TINY, *more)))
    setup.dry_run(40)
    learner, losses = setup.learner, []
    assert learner.updates > 0
    batch = learner.replay.sample()
    network, burn_in = learner.actor.module, learner.config.burn_in
    observed = [batch[key] for key in keys.observation_keys(setup.env.observation_spec)]
    total = torch.zeros(3)
    for row, missing in enumerate(batch[MISSING]):
        for uav in range(3):
            state = None
            for decision in range(observed[0].shape[2]):
                if decision < missing[uav]:
                    continue
                now = [x[row : row + 1, :, decision] for x in observed]
                action, state = network.step(now, state)
                if decision >= burn_in:
                    taught = batch[keys.TEACHER][row, uav, decision - burn_in]
                    difference = torch.nn.functional.smooth_l1_loss(action[0, uav], taught)
                    total[uav] += difference.detach()
    loss = learner.losses(batch)["imitation"].detach()
    assert loss.allclose(total / (len(batch) * learner.config.sequence))
    for _ in range(60):
        losses.append(learner.update(batch)["imitation"].mean().item())
    assert losses[-1] < 0.7 * losses[0]


def test_actors_with_a_memory_stay_near_to_those_they_began_with():
    """Without steps of the actors, the distance is 0; then it grows with their distance."""
    start = ["learner.anchor=1", "learner.warm_start=x"]  # read only when a run starts
    more = [*OFF_POLICY, *MEMORY, *start]
    learner = (setup := TrainingSetup(resolve("maps", settings("ddpg", *more)))).learner
    setup.dry_run(2 * learner.learning_starts)
    batch, anchor = learner.sample(), learner.anchor
    for name, value in learner.actor.module.state_dict().items():
        anchor.network.state_dict()[name].copy_(value)
    assert (learner._distance(anchor, batch) < 1e-12).all()
    anchor.network.action.bias.data.add_(0.1)
    distance = learner._distance(anchor, batch)
    assert (distance > 0).all()
    with torch.no_grad():
        inputs = [batch[key] for key in learner._observed], batch[MISSING], 2, 3
        apart = learner.actor.module(*inputs) - anchor.network(*inputs)
    assert distance.detach().allclose(anchor.weight * apart.square().div(2).mean((0, 2, 3)))
