"""Tests policies that emberlink has not trained, and exported policies."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.modules import GRUModule

import emberlink.trainers as trainers
from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.cli.main import main
from emberlink.trainers.evaluation.export import export
from emberlink.trainers.evaluation.foreign import FOREIGN, OnnxPolicy, new_run, reference_of
from emberlink.trainers.evaluation.policy import opened, to_evaluate
from emberlink.trainers.runs.pretrained import find

WORLD = {"setup": "tuned", "horizon": 20, "num_uavs": 3, "evaluation.scripted": []}
SOURCE = """
import numpy as np

def rise(observation, speed=1.0):
    assert observation.shape[1:] == (3, 6)
    return np.full((*observation.shape[:2], 3), [0.0, 0.0, speed])

def turn(observation, state):
    count = 0 if state is None else state + 1
    return np.full((*observation.shape[:2], 3), (-1.0) ** count), count

def fails(observation):
    return 1 / 0
shrinks = lambda observation: observation[0, :, :3]
divides = lambda observation: observation[..., :3] / 0
"""


@pytest.fixture
def source(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(SOURCE)
    return tmp_path


def score(policy, method="independent", **more):
    return trainers.evaluate(policy, method, episodes=2, **{**WORLD, **more})["huygens"]["learned"]


def test_a_function_a_module_and_a_tensordict_module_fly_alike(source):
    by_function = score("mine.py:rise")
    linear = torch.nn.Linear(6, 3)
    torch.nn.init.zeros_(linear.weight)
    linear.bias.data = torch.tensor([0.0, 0.0, 1.0])
    module = TensorDictModule(linear, in_keys=[keys.OBSERVATION], out_keys=[keys.ACTION])
    assert score(linear) == score(module) == by_function
    network = torch.nn.Sequential(linear, torch.nn.Dropout(0.9))
    assert score(network) == by_function
    assert network[1].training
    assert score("mine.py:rise", horizon=10) != by_function


BESIDE = """
from __future__ import annotations
from dataclasses import dataclass
import numpy as np
from {}up import UP

@dataclass
class Rise:
    speed: float

    def __call__(self, observation):
        return np.full((*observation.shape[:2], 3), UP) * self.speed

act = Rise(1.0)
"""


def test_a_file_imports_what_is_beside_it(source):
    for folder, dots in (("plain", ""), ("package", ".")):
        Path(folder).mkdir()
        Path(folder, "up.py").write_text("UP = [0.0, 0.0, 1.0]")
        Path(folder, "net.py").write_text(BESIDE.format(dots))
    Path("package/__init__.py").touch()
    for name in ("plain/net.py:act", "package.net:act"):
        assert score(name) == score("mine.py:rise")


def test_a_run_flies_under_another_name(tmp_path):
    run, short = "pretrained:strong/independent", {"episodes": 1, "horizon": 40, "scripted": False}
    expected = trainers.evaluate(run, **short)
    settings = {**short, "name": "again", "seed": 3, "output": str(tmp_path)}
    assert trainers.evaluate(run, "independent", **settings) == expected
    assert trainers.evaluate(trainers.load(run), "independent", **short) == expected
    (folder,) = tmp_path.iterdir()
    assert trainers.evaluate(folder, **short) == expected
    row = trainers.compare(folder).table.iloc[0]
    assert (row["label"], row["seed"]) == ("again", 3)
    with pytest.raises(UserError):
        export(folder, tmp_path / "again.onnx")
    assert not list(tmp_path.glob("again.*"))


def test_state_begins_with_none_and_is_handed_on(source):
    seen = []

    def turns(observation, state):
        seen.append(state)
        count = 0 if state is None else state + 1
        return np.full((*observation.shape[:2], 3), (-1.0) ** count), count

    assert score(turns) == score("mine.py:turn")
    assert seen == [None, *range(19)]


def test_a_memory_of_torchrl_begins_empty():
    states = []

    state, outputs = "recurrent_state", torch.nn.Unflatten(-1, (3, 3))
    module: Any = TensorDictModule
    parts: Any = [
        module(torch.nn.Flatten(-2), in_keys=[keys.OBSERVATION], out_keys=["features"]),
        module(lambda x: states.append(x.clone()), in_keys=[state], out_keys=[]),
        GRUModule(
            input_size=18,
            hidden_size=4,
            in_keys=["features", state],
            out_keys=["features", ("next", state)],
        ),
        module(torch.nn.Linear(4, 9), in_keys=["features"], out_keys=["features"]),
        module(outputs, in_keys=["features"], out_keys=[keys.ACTION]),
    ]
    score(TensorDictSequential(*parts))
    assert not states[0].any()
    assert all(state.any() for state in states[1:])


def test_a_dictionary_where_an_observation_has_several_tensors():
    shapes = {}

    def look(observation):
        shapes.update({name: part.shape for name, part in observation.items()})
        return np.zeros((50, 3, 3))

    trainers.evaluate(look, "independent", episodes=1, **{**WORLD, "observation": "window"})
    assert shapes == {"observation": (50, 3, 6), "window": (50, 3, 3, 5, 5)}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mine.py:shrinks", r"mine: .*\[3, 3\]; expected \[50, 3, 3\]"),
        ("mine.py:divides", "mine: an action is NaN or infinite"),
        ("mine.py:rises", "known: rise, turn"),
        ("yours.py:rise", "yours.py: there is no such file"),
        ("yours.one:rise", "yours.one: No module named 'yours'"),
    ],
)
def test_a_wrong_name_shape_or_number_is_one_line(source, name, message):
    with pytest.raises(UserError, match=message) as error:
        score(name, name="mine")
    assert "\n" not in str(error.value)


def test_errors_of_its_own_code_keep_their_traceback(source):
    with pytest.raises(ZeroDivisionError) as error:
        score("mine.py:fails")
    assert error.traceback[-1].path == source / "mine.py"
    Path("imports.py").write_text("import no_such_module")
    with pytest.raises(ModuleNotFoundError):
        score("imports.py:act")


def test_comparisons_and_replays_read_its_folder(source, capsys):
    options = "setup=tuned env.horizon=20 env.num_uavs=3 evaluation.scripted=[] --fires 2"
    for seed in (0, 1):
        words = f"eval mine.py:turn independent {options} seed={seed} --name turner"
        assert main(words.split()) == 0
    folders = sorted(Path("runs").iterdir())
    table = trainers.compare("runs", "compared").ranking
    page = Path("compared/compare.html").read_text()
    assert page.count("<img") == 1, "no curves of trainings that were not"
    assert set(table["label"]) == {"turner"}
    assert table["seeds"].iloc[0] == [0, 1]
    again = json.loads((folders[0] / "eval.json").read_text())["results"]
    assert trainers.evaluate(folders[0], episodes=2)["huygens"] == again["huygens"]
    assert main(["render", str(folders[0]), "--output", "replay.html"]) == 0
    assert "turner" in trainers.load(folders[0]).panel().title
    to_evaluate(folders[0], "independent", ["env.num_uavs=2"])


def test_a_folder_that_names_code_inside_it_is_refused(tmp_path):
    config = replace(trainers.load("pretrained:consensus").config, output=str(tmp_path))
    for place in ("{run}/evil.py:act", "evil.py:act", "os:system"):
        run = new_run("", "evil", config)
        (run.path / "evil.py").write_text("raise SystemExit('ran')")
        reference = place.format(run=run.path)
        (run.path / FOREIGN).write_text(json.dumps({"name": "evil", "policy": reference}))
        with pytest.raises(UserError, match="names no policy outside of its folder"):
            reference_of(run)
    with pytest.raises(UserError, match="its policy was an object"):
        reference_of(new_run("", "object", config))


@pytest.mark.parametrize(
    ("name", "method", "message"),
    [
        ("strong/maps", "consensus", "strong/maps: a policy of maps .*'crops'.* consensus "),
        ("strong/independent", "shared_memory", ""),
    ],
)
def test_a_policy_of_another_method_flies_where_it_observes_the_same(name, method, message):
    with pytest.raises(UserError, match=message) if message else nullcontext():
        to_evaluate(f"pretrained:{name}", method)


def exported(run, tmp_path):
    """Exports a run, and returns its policy and the ONNX file's."""
    export(str(run), tmp_path / "policy.onnx")
    return trainers.load(run), opened(str(tmp_path / "policy.onnx"))[0]


def check_same_actions(policy, onnx: OnnxPolicy, steps: int, num_envs: int = 2, **changes):
    """Checks that both act alike on the way that the policy flies: float32 sums differ in order."""
    config = policy.config
    env = trainers.make_env(config, num_envs=num_envs, seed=1, **changes)
    td, state = env.reset(), None
    for step in range(steps):
        td = policy(td)
        if step % config.policy.hold == 0:
            action, state = onnx(td, state)
            torch.testing.assert_close(action, td.get(keys.ACTION), atol=1e-4, rtol=0)
        td = env.step_mdp(env.step(td))


@pytest.mark.slow  # torch.onnx takes 10 seconds; test_own_learner.py exports a file in one
@pytest.mark.parametrize(
    "settings",
    [
        {"policy.message": "attention", "share_parameters": True},
        {"policy.message": "attention", "memory": "none", "env.radio.delay": 7},
        {"policy.message": "mean", "observation": "map", "share_parameters": True},
        {"memory": "none", "share_parameters": False, "observation": "window"},
    ],
    ids=lambda settings: "-".join(map(str, settings.values())),
)
def test_an_onnx_file_acts_like_the_run(settings, tmp_path):
    run = trainers.train(
        "independent",
        setup="strong",
        output=str(tmp_path),
        evaluate_after=False,
        **{**TINY, **settings},
    )
    policy, onnx = exported(run.path, tmp_path)
    check_same_actions(policy, onnx, 40)
    if settings.get("share_parameters"):
        other = trainers.load(run.path, num_uavs=5)
        check_same_actions(other, onnx, 20, num_envs=3)
    late = {"num_uavs": 3, "radio.delay": 7} if policy.config.env.radio.delay else {}
    for key, made in late.items():
        with pytest.raises(UserError, match=f"policy.onnx: env.{key}=5; .* for env.{key}={made}"):
            to_evaluate(str(tmp_path / "policy.onnx"), "independent", [f"env.{key}=5"])
    card = json.loads((tmp_path / "policy.json").read_text())
    assert card["method"] == "independent"
    assert list(card["inputs"]) == list(onnx.inputs)
    file = str(tmp_path / "policy.onnx")
    of_file = trainers.evaluate(file, "independent", episodes=2, scripted=False)
    of_run = trainers.evaluate(run.path, episodes=2)
    coverage = [of["huygens"]["learned"]["coverage"] for of in (of_file, of_run)]
    assert coverage[0] == pytest.approx(coverage[1], abs=1.0)


TINY = {
    "episodes": 1,
    "num_envs": 2,
    "env.num_uavs": 3,
    "env.horizon": 40,
    "hidden": [8],
    "units": 8,
    "minibatches": 1,
    "evaluation.interval": 0,
    "evaluation.scripted": [],
}


@pytest.mark.heavy
@pytest.mark.parametrize("name", sorted({"/".join(p.parts[-3:-1]) for p in find("pretrained:*")}))
def test_pretrained_policies_as_onnx_files_act_alike_over_an_episode(name, tmp_path):
    policy, onnx = exported(f"pretrained:{name}", tmp_path)
    check_same_actions(policy, onnx, 1000)
