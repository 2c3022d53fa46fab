"""Tests messages that are learned against a scalar twin, and what may cross which link."""

import itertools
from typing import Any

import pytest
import torch

from emberlink.envs import keys
from emberlink.envs.config import RadioConfig
from emberlink.policies.gaussian import GaussianActor
from emberlink.policies.networks.messages import message_bytes, message_lag
from emberlink.policies.networks.sequence import GaussianNetwork, SequenceNetwork
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers import make_env
from emberlink.trainers.build import build_actor
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

UAVS, FEATURES, SIZE, ENVS = 4, 6, 5, 2
SCHEMES = ["mean", "attention"]
CASES = list(itertools.product(SCHEMES, ["none", "gru"], [True, False], [0, 2]))
CASE = "scheme", "memory", "shared", "lag"


def network(scheme: str, memory: str = "gru", shared: bool = True, lag=0, uavs=UAVS) -> Any:
    policy = PolicyConfig(memory=memory, units=7, message=scheme, message_size=SIZE)
    start = torch.Generator().manual_seed(3)
    more = {"share_parameters": shared, "lag": lag, "generator": start}
    made = GaussianNetwork(uavs, [(FEATURES,)], 3, (8,), policy=policy, **more)
    for weight in made.parameters():  # no zeros, and outputs that differ
        weight.data.add_(torch.randn(weight.shape, generator=start), alpha=0.3)
    return made.double()


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def links(decisions: int, seed: int = 1) -> torch.Tensor:
    """Returns random links, in which some UAVs hear nobody."""
    hears = drawn(ENVS, decisions, UAVS, UAVS, seed=seed) > 0.2
    hears[:, 0, 1] = False
    return hears & ~torch.eye(UAVS, dtype=torch.bool)


class Twin:
    """Computes means UAV by UAV and message by message; rounding errors count as constants.

    Args:
        net: the network.
        lag: decisions from saying a message to hearing it.
        kept: rounding errors of an earlier pass, added instead of rounding anew.
    """

    def __init__(self, net: Any, lag: int, kept: list[torch.Tensor] | None = None):
        self.net, self.lag, self.kept, self.errors = net, lag, kept, []

    def row(self, uav: int) -> int:
        return 0 if self.net.grouping.shared else uav

    def linear(self, layer, uav: int, x: torch.Tensor) -> torch.Tensor:
        return x @ layer.weight[self.row(uav)] + layer.bias[self.row(uav), 0]

    def rounded(self, x: torch.Tensor) -> torch.Tensor:
        y = x.tanh()
        error = (y * 127).round() / 127 - y if self.kept is None else self.kept[len(self.errors)]
        self.errors.append(error.detach())
        return y + error.detach()

    def gru(self, uav: int, x: torch.Tensor, h: torch.Tensor) -> torch.Tensor:
        memory = self.net.memory
        if memory.size == 0:
            return x
        x = self.linear(memory.input, uav, x).tanh()
        k = self.row(uav)
        a = memory.input_weight[k] @ x + memory.input_bias[k]
        b = memory.state_weight[k] @ h + memory.state_bias[k]
        (ar, az, an), (br, bz, bn) = a.chunk(3), b.chunk(3)
        keep = (az + bz).sigmoid()
        return (1 - keep) * (an + (ar + br).sigmoid() * bn).tanh() + keep * h

    def means(self, observed: torch.Tensor, hears: torch.Tensor) -> torch.Tensor:
        """Maps one environment, [decisions, uavs, features], to [decisions, uavs, 3]."""
        size, states, means = self.net.memory.size, None, []
        states = [observed.new_zeros(size) for _ in range(UAVS)]
        said, sent = self.net.messages, []
        for x, linked in zip(observed, hears, strict=True):
            mine = [torch.cat((x[u], states[u])) for u in range(UAVS)]
            message = [self.rounded(self.linear(said.say, u, mine[u])) for u in range(UAVS)]
            read = []
            attends = hasattr(said, "key")
            key = (
                [self.rounded(self.linear(said.key, u, mine[u])) for u in range(UAVS)]
                if attends
                else []
            )
            sent.append((message, key, linked))
            nobody = [], [], torch.zeros(UAVS, UAVS)
            message, key, heard = sent[-1 - self.lag] if len(sent) > self.lag else nobody
            for u in range(UAVS):
                total = observed.new_zeros(SIZE)
                others = [v for v in range(UAVS) if heard[u, v]]
                if attends and others:
                    query = self.linear(said.query, u, mine[u])
                    weight = [(query @ key[v] / 8**0.5).exp() for v in others]
                    for w, v in zip(weight, others, strict=True):
                        total = total + w / sum(weight) * message[v]
                elif others:
                    total = sum(message[v] for v in others) / len(others)
                read.append(total)
            outputs = []
            for u in range(UAVS):
                y = self.gru(u, torch.cat((x[u], read[u])), states[u])
                states[u] = y if size else states[u]
                for layer in self.net.hidden:
                    y = self.linear(layer, u, y).tanh()
                outputs.append(self.linear(self.net.output, u, y))
            means.append(torch.stack(outputs))
        return torch.stack(means)


@pytest.mark.parametrize(CASE, CASES)
def test_means_and_gradients_equal_those_of_a_scalar_twin(scheme, memory, shared, lag):
    net, hears = network(scheme, memory, shared, lag), links(5)
    observed = drawn(ENVS, 5, UAVS, FEATURES)
    mean, _ = net(net.empty_state(ENVS), observed, hears)
    weights = [w for name, w in net.named_parameters() if name.startswith("messages")]
    for env in range(ENVS):
        expected = Twin(net, lag).means(observed[env], hears[env])
        torch.testing.assert_close(mean[env], expected)
        gradients, others = (
            torch.autograd.grad(means[:, 2].sum(), weights, retain_graph=True)
            for means in (mean[env], expected)
        )
        for gradient, other in zip(gradients, others, strict=True):
            torch.testing.assert_close(gradient, other)
        if not shared:  # the hearer's own weights say nothing to it, except through others
            assert gradients[0].abs().sum((1, 2)).count_nonzero() >= 2


@pytest.mark.parametrize(CASE, CASES)
def test_gradients_cross_uavs_as_finite_differences_say(scheme, memory, shared, lag):
    net, hears = network(scheme, memory, shared, lag), links(3)[0]
    observed = drawn(3, UAVS, FEATURES)
    first = Twin(net, lag)
    first.means(observed, hears)
    mean, _ = net(net.empty_state(1), observed[None], hears[None])
    weights = [w for name, w in net.named_parameters() if name.startswith("messages")]
    gradients = torch.autograd.grad(mean[0, -1, 2].sum(), weights)
    for weight, gradient in zip(weights, gradients, strict=True):
        entry = weight.data.view(-1)
        for index in (0, weight.numel() // 2, weight.numel() - 1):
            outputs = []
            for step in (1e-6, -2e-6):
                entry[index] += step
                outputs.append(Twin(net, lag, first.errors).means(observed, hears)[-1, 2].sum())
            entry[index] += 1e-6
            slope = (outputs[0] - outputs[1]) / 2e-6
            torch.testing.assert_close(gradient.reshape(-1)[index], slope, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_permutation_of_the_uavs_permutes_the_actions(scheme):
    net, observed, hears = network(scheme, "gru"), drawn(ENVS, 4, UAVS, FEATURES), links(4)
    order = torch.randperm(UAVS, generator=torch.Generator().manual_seed(1))
    mean, _ = net(net.empty_state(ENVS), observed, hears)
    moved, _ = net(net.empty_state(ENVS), observed[:, :, order], hears[:, :, order][..., order])
    torch.testing.assert_close(moved, mean[:, :, order])


@pytest.mark.parametrize("scheme", ["none", *SCHEMES])
@pytest.mark.parametrize("memory", ["none", "gru"])
@pytest.mark.parametrize("lag", [0, 3])
def test_decision_by_decision_equals_the_sequence(scheme, memory, lag):
    net = network(scheme, memory, lag=lag)
    given = [drawn(ENVS, 6, UAVS, FEATURES), links(6)][: 1 + (scheme != "none")]
    whole, std = net(net.empty_state(ENVS), *given)
    state = None
    for k in range(6):
        mean, state = net.step([each[:, k] for each in given], state)
        torch.testing.assert_close(mean, whole[:, k])
    assert std.equal(net.std(torch.Size((ENVS, UAVS)))[:, None].expand_as(whole))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_late_message_crosses_only_the_link_that_it_was_sent_on(scheme):
    """UAV 3 speaks at decision 1; who hears it then acts otherwise two decisions later."""
    net, observed, hears = network(scheme, "none", lag=2), drawn(1, 6, UAVS, FEATURES), links(6)[:1]
    other = observed.clone()
    other[0, 1, 3] += 1
    hears[0, 1, :, 3] = torch.tensor([True, False, True, False])
    hears[0, 3, :, 3] = torch.tensor([False, True, False, False])
    means = [net(net.empty_state(1), x, hears)[0][0] for x in (observed, other)]
    changed = (means[0] != means[1]).any(-1)
    expected = torch.zeros(6, UAVS, dtype=torch.bool)
    expected[1, 3] = expected[3, 0] = expected[3, 2] = True
    assert changed.equal(expected)


def test_messages_in_flight_at_the_beginning_of_a_chunk_are_heard_and_are_constants():
    net, observed, hears = network("mean", "none", lag=2), drawn(1, 4, UAVS, FEATURES), links(4)[:1]
    before = net(net.empty_state(1), observed[:, :2], hears[:, :2])[0]
    _, state = SequenceNetwork.forward(net, net.empty_state(1), observed[:, :2], hears[:, :2])
    after = net(state.detach(), observed[:, 2:], hears[:, 2:])[0]
    whole = net(net.empty_state(1), observed, hears)[0]
    torch.testing.assert_close(torch.cat((before, after), 1), whole)
    weight = net.messages.say.weight
    assert torch.autograd.grad(whole.sum(), weight)[0].any()
    assert not torch.autograd.grad(after.sum(), weight)[0].any()


def test_a_late_message_is_heard_at_the_first_decision_at_or_after_its_arrival():
    cases = {(0, 1): 0, (1, 1): 1, (7, 1): 7, (1, 5): 1, (5, 5): 1, (6, 5): 2}
    for (delay, hold), lag in cases.items():
        policy = PolicyConfig(message="mean", hold=hold)
        assert message_lag(policy, RadioConfig(delay=delay)) == lag


@pytest.mark.parametrize(("delay", "hold"), [(2, 1), (3, 2)])
def test_a_team_hears_late_messages_by_the_links_of_their_decision(delay, hold):
    """In a world with losses, actions equal those of a network that is shown all decisions."""
    more = {"policy.hold": hold, "env.radio.delay": delay, "env.radio.loss": 0.4, "horizon": 12}
    more |= {"policy.message": "attention", "policy.memory": "none", "env.radio.range": 20}
    config = resolve("independent", ["setup=strong", "fire.num_train_fires=2"], **more)
    env = make_env(config, num_envs=3, seed=0)
    policy: Any = build_actor(config, env, torch.Generator().manual_seed(0))
    policy.module.output.weight.data.mul_(100)
    run = env.rollout(12, policy)[:, ::hold]
    actor = policy if hold == 1 else policy.policy
    observed = [run[key] for key in actor.observed]
    assert not observed[-1].equal(observed[-1][:, :1].expand_as(observed[-1]))
    mean, _ = actor.module(actor.module.empty_state(3), *observed)
    torch.testing.assert_close(run[keys.ACTION], mean.clamp(-1, 1))


def test_a_network_flies_teams_of_any_size():
    net = network("attention")
    larger = network("attention", uavs=9)
    larger.load_state_dict(net.state_dict())
    hears = torch.ones(1, 9, 9, dtype=torch.bool) & ~torch.eye(9, dtype=torch.bool)
    mean, _ = larger.step([drawn(1, 9, FEATURES), hears], None)
    assert mean.shape == (1, 9, 3)


def test_bytes_are_those_of_values_and_keys():
    sizes = [message_bytes(PolicyConfig(message=s, message_size=16)) for s in ("none", *SCHEMES)]
    assert sizes == [0, 16, 24]


@pytest.mark.parametrize("hold", [1, 5])
def test_bytes_are_sent_at_decisions_by_those_that_fly(hold):
    more = {"policy.message": "mean", "policy.message_size": 3, "policy.hold": hold}
    env = make_env("independent", "strong", num_envs=4, seed=0, horizon=20, failures=3.0,
                   measures="all", num_train_fires=2, **more)  # fmt: skip
    rollout = env.rollout(20)
    sent, alive = rollout["next", *keys.BYTES_SENT], rollout["next", *keys.ALIVE]
    decides = (rollout["next", keys.STEP] % hold == 0)[..., None]
    assert not alive.all()
    assert sent.equal(3 * (alive & decides))


def test_weights_of_a_scheme_do_not_cross_a_missing_link():
    net, features = network("mean"), drawn(1, ENVS * UAVS, SIZE)
    message, hears = drawn(ENVS, UAVS, SIZE), links(1)[:, 0]
    net.messages.weights = lambda features, key, hears: torch.ones(hears.shape)
    heard = net.messages(features, message, message[..., :0], hears)
    assert heard.view(message.shape).equal(hears.double() @ message)


def test_a_lost_message_contributes_nothing():
    """With all messages lost, a team flies as with the radio off; with none lost, otherwise."""
    more = {"policy.message": "attention", "policy.memory": "none", "policy.hold": 1}
    more |= {"num_envs": 2, "num_train_fires": 2, "seed": 0}
    policy, flown = PolicyConfig(message="attention"), []
    for radio in ({"env.radio.loss": 1.0}, {"env.radio.range": 0}, {}):
        env = make_env("independent", "strong", **{**more, "env.radio.range": 90, **radio})
        spec, start = env.observation_spec, torch.Generator().manual_seed(3)
        net = GaussianNetwork(
            6, keys.observation_shapes(spec), 3, (8,), policy=policy, generator=start
        )
        net.output.weight.data.mul_(100)
        flown.append(env.rollout(5, GaussianActor(net, spec))[keys.POSITION])
    assert flown[0].equal(flown[1])
    assert not flown[0].equal(flown[2])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_faults_change_what_a_trained_team_does(scheme):
    setup = TrainingSetup(resolve("independent", [
        "setup=strong", f"policy.message={scheme}", "env.horizon=40", "num_envs=4", "episodes=2",
        "env.radio.range=20",
    ]))  # fmt: skip
    setup.dry_run(80)
    net = setup.learner.actor.module
    observed, hears = drawn(4, 6, FEATURES).float(), torch.ones(4, 6, 6) - torch.eye(6) > 0

    def acted(fault: str, links=hears) -> torch.Tensor:
        net.messages.fault = fault
        return net.step([observed, links], None)[0]

    as_said, silent = acted("none"), acted("none", torch.zeros_like(hears))
    assert acted("zero").equal(silent)
    assert not as_said.equal(silent)
    shuffled = acted("shuffle")
    assert not shuffled.equal(as_said)
    # By hand: what UAV 0 of environment 0 does if only UAV 2 speaks, with the words of UAV 1 of 3.
    only = torch.zeros_like(hears)
    only[0, 0, 2] = only[3, 0, 1] = True
    moved = observed.clone()
    moved[3, 0] = observed[0, 0]
    net.messages.fault = "none"
    expected = net.step([moved, only], None)[0][3, 0]
    torch.testing.assert_close(acted("shuffle", only)[0, 0], expected)
