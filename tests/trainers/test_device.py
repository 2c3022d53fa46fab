"""Tests the requirements of GPUs on a CPU: no synchronisation, and TorchRL's transitions."""

import pytest
import torch
from test_recipes import METHODS
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.collectors import Collector

from emberlink.configs import known
from emberlink.envs import keys
from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.rollout.collector import LockstepCollector
from emberlink.trainers.rollout.cuda_graphs import graphed
from emberlink.trainers.training.setup import TrainingSetup

SMALL = [
    *("env.horizon=12", "env.num_uavs=3", "num_envs=2", "episodes=3", "learner.batch_size=8"),
    *("learner.hidden=[8,8]", "fire=huygens"),
    *("learner.exploration.sigma=0.4", "learner.exploration.dt=1"),
]


@pytest.fixture(autouse=True)
def lockstep(monkeypatch):
    """Trains with the collector for GPUs."""
    monkeypatch.setattr("emberlink.trainers.training.setup.make_collector", LockstepCollector)


def torchrls(setup: TrainingSetup) -> Collector:
    """Returns TorchRL's collector over an environment like that of the setup."""
    config, envs = setup.config, len(setup.collector.carried)
    env = build_env(config, num_envs=envs, fire=config.fire, seed=setup.seeds, device="cpu")
    return Collector(
        env,
        setup.learner.explorer,
        frames_per_batch=envs,
        total_frames=setup.total_steps * envs,
        trust_policy=True,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )


@pytest.mark.parametrize("seeds", ["seed=5", "seeds=[5,6]"])
@pytest.mark.parametrize("method", [*METHODS, "maps"])
def test_our_collector_equals_torchrls(method, seeds):
    setup = TrainingSetup(resolve(method, [*SMALL, seeds, "learner.exploration.theta=0.2"]))
    torch.nn.init.normal_(setup.learner.actor.module.action.weight, std=0.3)
    pairs = zip(torchrls(setup), setup.collector, strict=True)
    count = 0
    for theirs, ours in pairs:
        count += 1
        assert ours.batch_size == theirs.batch_size
        for key in theirs.keys(include_nested=True, leaves_only=True):
            assert ours[key].equal(theirs[key]), (count, key)
    assert count == 36


class Waiting(TorchDispatchMode):
    """Records the operations that would synchronise with a GPU."""

    NAMES = (
        *("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "item", "masked_select"),
        *("unique", "_unique2", "unique_dim", "allclose", "lift_fresh"),
    )

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.removeprefix("aten::")
        by_mask = name.startswith("index") and any(
            isinstance(index, torch.Tensor) and index.dtype == torch.bool
            for index in (args[1] if len(args) > 1 and isinstance(args[1], list | tuple) else ())
        )
        if name in self.NAMES or by_mask:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


class Elsewhere(TorchFunctionMode):
    """Records the calls that create a tensor on the CPU or move a tensor."""

    MAKES = (
        *("arange", "zeros", "ones", "full", "empty", "tensor", "as_tensor", "eye", "rand"),
        *("randn", "randint", "linspace", "from_numpy", "scalar_tensor"),
    )
    MOVES = ("cpu", "cuda", "item", "tolist", "numpy", "pin_memory")

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        # No synchronisation: fused Adam requests its flag on the same device.
        there = kwargs == {"non_blocking": True}
        moves = name == "to" and not (there or any(isinstance(arg, torch.dtype) for arg in args))
        if moves or name in self.MOVES or (name in self.MAKES and kwargs.get("device") is None):
            self.found.append(name)
        return func(*args, **kwargs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("watch", "seeds"), [(Waiting, "seed=5"), (Elsewhere, "seeds=[5,6]")], ids=["waits", "moves"]
)
@pytest.mark.parametrize(
    ("setup", "learner"), [("paper", "ddpg"), ("released", "ddpg"), ("tuned", "td3")]
)
@pytest.mark.parametrize("method", METHODS)
def test_no_step_leaves_the_device(method, setup, learner, watch, seeds):
    """A step has environment, communication, noise, replay buffer and update, within an episode."""
    settings = [f"setup={setup}", f"learner={learner}", *SMALL, seeds, "env.reward.unseen=-0.1"]
    training = TrainingSetup(resolve(method, settings))
    rollouts = iter(training.collector)
    for _ in range(6):
        training.learn(next(rollouts))
    with watch() as watched:
        for _ in range(4):
            training.learn(next(rollouts))
    assert training.learner.updates > 4
    assert watched.found == []


class OnGpu(TorchFunctionMode):
    """Lets tensors on the CPU take the code paths of GPUs."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func == torch.Tensor.is_cuda.__get__:
            return True
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("limit", ["null", "40"])
@pytest.mark.parametrize("world", [world for world in known("world") if world != "file"])
def test_maps_on_the_paths_of_gpus(world, limit):
    """No step of `maps` leaves the device, and all of it equals the paths of CPUs."""
    settings = ["setup=tuned", f"world={world}", "env.horizon=25", "env.num_uavs=6"]
    settings += ["env.reward.unseen=-0.1", "num_envs=2"]
    radio = ["env.measures=all", "env.radio.range=30", f"env.radio.bandwidth={limit}"]
    config = resolve("maps", [*settings, *radio])
    about = {"num_envs": 2, "seed": 1, "fire": config.fire, "device": "cpu"}
    ours, theirs = build_env(config, **about), build_env(config, **about)
    one, two = ours.reset(), theirs.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        action = torch.rand(one[keys.POSITION].shape, generator=generator) * 2 - 1
        one[keys.ACTION] = two[keys.ACTION] = action
        with Waiting() as waiting, Elsewhere() as elsewhere, OnGpu():
            one = ours.step(one)
        two = theirs.step(two)
        assert not waiting.found + elsewhere.found
        assert (one == two).all()
        one, two = ours.step_mdp(one), theirs.step_mdp(two)
    assert two[keys.BYTES_SENT].sum() > 0


def test_tensors_on_the_cpu_are_recorded():
    ones = torch.ones(3)
    with Elsewhere() as elsewhere:
        torch.zeros(3)
        torch.zeros(3, device="cpu")
        ones.tolist()
        ones.to("cpu")
        ones.to(torch.float64)
    assert elsewhere.found == ["zeros", "tolist", "to"]


def test_synchronisation_is_recorded():
    ones = torch.ones(3)
    with Waiting() as waiting:
        ones.sum().item()
        ones[ones > 0]
        torch.tensor([1.0])
    assert waiting.found == ["_local_scalar_dense", "index", "lift_fresh"]


def test_functions_are_not_captured_on_a_cpu():
    assert graphed(dict, "cpu") is dict
