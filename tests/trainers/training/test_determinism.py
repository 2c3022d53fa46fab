"""Tests that a seed determines a run, independent of other computations."""

import pytest
import torch
from test_recipes import METHODS
from test_resume import REPLAY, begun, until
from torchrl.envs import check_env_specs

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.wildfire import WildfireEnv
from emberlink.trainers import make_env


@pytest.mark.heavy
@pytest.mark.parametrize("method", [*METHODS, "maps"])
def test_a_seed_repeats_its_run_byte_for_byte(method, tmp_path):
    def run(folder: str, seed: int) -> tuple[bytes, dict[str, torch.Tensor]]:
        torch.manual_seed(len(folder))  # earlier draws must not matter
        trainer = until(
            begun(method, tmp_path / folder, "episodes=2", f"seed={seed}", *REPLAY), None
        )
        learner = trainer.setup.learner
        assert learner.updates > 0
        return (trainer.run.path / "metrics.jsonl").read_bytes(), learner.weights()

    (first, weights), (again, same), (other, _) = run("one", 7), run("again", 7), run("another", 8)
    assert first.count(b"\n") == 2
    assert first == again
    assert first != other
    for name, weight in weights.items():
        assert weight.equal(same[name]), name


ON_POLICY = ["learner=mappo", "env.base=[0,15]", "env.horizon=40"]


@pytest.mark.parametrize(
    ("method", "more"), [*((method, []) for method in [*METHODS, "maps"]), ("maps", ON_POLICY)]
)
def test_the_default_dtype_does_not_change_a_training(method, more, tmp_path):
    """A program that uses emberlink may prefer float64."""
    more, step = (
        (more, 40) if more else (REPLAY, 35)
    )  # on-policy learners learn at the end of an episode
    usual = until(begun(method, tmp_path / "usual", *more), step)
    torch.set_default_dtype(torch.float64)
    try:
        other = until(begun(method, tmp_path / "other", *more), step)
        check_env_specs(make_env(method))
    finally:
        torch.set_default_dtype(torch.float32)
    assert other.setup.learner.updates > 0
    weights = other.setup.learner.actor.state_dict()
    for name, value in usual.setup.learner.actor.state_dict().items():
        assert weights[name].dtype == value.dtype
        # TorchRL's coefficients of PPO and its estimate of advantages round as the default dtype.
        torch.testing.assert_close(weights[name], value, rtol=0, atol=1e-6 if more else 0)


@pytest.mark.parametrize("fire", ["paper", "huygens"])
def test_an_environment_does_not_depend_on_the_batch_size(fire):
    """Compares two episodes with the same actions."""
    world = WildfireConfig(horizon=15)
    few, many = (WildfireEnv(count, world, fire=fire, seed=3) for count in (2, 5))
    generator = torch.Generator().manual_seed(0)
    for _ in range(2):
        tds = [env.reset() for env in (few, many)]
        for _ in range(15):
            small, large = tds
            for key in (keys.OBSERVATION, keys.POSITION, keys.RNG_KEY, keys.BURNING):
                assert small[key].equal(large[key][:2]), key
            assert not large[keys.RNG_KEY][2:].unsqueeze(1).eq(small[keys.RNG_KEY]).any()
            action = torch.rand(5, *small[keys.POSITION].shape[1:], generator=generator) * 2 - 1
            tds = [
                env.step(td.set(keys.ACTION, action[: len(td)]))["next"]
                for env, td in zip((few, many), tds, strict=True)
            ]
