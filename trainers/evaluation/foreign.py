"""Opens policies that emberlink has not trained: a Python function or module, or an ONNX file."""

import importlib
import importlib.util
import inspect
import json
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.utils import get_primers_from_module

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError, naming, require
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.pretrained import is_name
from emberlink.trainers.runs.run_folder import MAX_YAML, RunFolder, read_text

METADATA = "emberlink"
"""key of an ONNX file's metadata: what `emberlink export` says of the policy, as JSON"""
FOREIGN = "policy.json"
"""file of a run folder whose policy emberlink has not trained: its name, and where it is"""


class ForeignPolicy(TensorDictModuleBase):
    """Calls a policy with the observations of a team, and writes ("agents", "action").

    Args:
        policy: a TensorDictModule, an `nn.Module`, a function, or an `OnnxPolicy`. A function gets
            an array [B, n, features] and returns actions [B, n, 3]; an `nn.Module` the same as
            tensors. Where an observation has several tensors, they come as a dictionary by name.
            With a second argument it gets its state of the decision before, None at the first, and
            returns the action and the new state.
        name: begins the message if its actions have another shape, are NaN or infinite.
        observed: keys of the observation, see `keys.observation_keys`.
    """

    def __init__(self, policy: Any, name: str, observed: list[Any]):
        super().__init__()
        self.name, self.observed, self.state = name, observed, None
        self.policy: Any = policy
        reads: list[Any] = [*observed, keys.STEP]
        writes: list[Any] = [keys.ACTION]
        self.in_keys, self.out_keys = reads, writes
        self._stateful = self._primer = None
        if isinstance(policy, TensorDictModuleBase):
            with warnings.catch_warnings(action="ignore"):  # that there is none
                self._primer = get_primers_from_module(policy)
        else:
            self._stateful = takes_state(policy)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        in_training = [layer for layer in self.modules() if layer.training]
        self.eval()  # dropout, batch norm
        try:
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                action = self._act(tensordict)
        finally:
            for layer in in_training:
                layer.training = True
        expected = (*tensordict.get(keys.POSITION).shape[:-1], 3)
        if tuple(action.shape) != expected:
            raise UserError(
                f"{self.name}: the actions have the shape {list(action.shape)}; expected "
                f"{list(expected)}, [environments, UAVs, (x, y, z)]"
            )
        if not action.isfinite().all():
            raise UserError(f"{self.name}: an action is NaN or infinite")
        return tensordict.set(keys.ACTION, action)

    def _act(self, tensordict: TensorDictBase) -> Tensor:
        began = tensordict.get(keys.STEP) == 0
        if isinstance(self.policy, TensorDictModuleBase):
            if self._primer is not None:  # of TorchRL's memories, such as GRUModule
                tensordict.set("is_init", began.unsqueeze(-1))
                specs: Any = self._primer.primers
                for key, spec in specs.items(True, True) if began.all() else ():
                    shape = (*tensordict.batch_size, *spec.shape)
                    tensordict.set(key, torch.zeros(shape, dtype=spec.dtype, device=began.device))
            return self.policy(tensordict)[keys.ACTION]
        if began.all():
            self.state = None
        if isinstance(self.policy, OnnxPolicy):
            action, self.state = self.policy(tensordict, self.state)
            return action
        parts = {key[-1]: tensordict.get(key) for key in self.observed}
        if not isinstance(self.policy, nn.Module):
            parts = {name: part.cpu().numpy() for name, part in parts.items()}
        observation = parts if len(parts) > 1 else next(iter(parts.values()))
        if self._stateful:
            action, self.state = self.policy(observation, self.state)
        else:
            action = self.policy(observation)
        return torch.as_tensor(action).to(tensordict.get(keys.POSITION))


class OnnxPolicy:
    """Runs a decision of an ONNX file, such as `emberlink export` writes.

    Inputs are named by the last part of their key; the output `next_X` is the next value of the
    input X, which is 0 at first.
    """

    def __init__(self, file: Path):
        require("onnxruntime", "export", str(file))
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        self.file = file
        with naming(file, Exception):  # onnxruntime's errors share no class
            self.session = onnxruntime.InferenceSession(str(file), options)
        self.inputs = {one.name: one for one in self.session.get_inputs()}
        self.outputs = [one.name for one in self.session.get_outputs()]
        if "action" not in self.outputs:
            raise UserError(f"{file}: has no output 'action'; outputs: {', '.join(self.outputs)}")
        text = self.session.get_modelmeta().custom_metadata_map.get(METADATA, "{}")
        self.card: dict[str, Any] = json.loads(text)

    def __call__(self, tensordict: TensorDictBase, state: Any) -> tuple[Tensor, Any]:
        place, given = tensordict.get(keys.POSITION), {}
        state = state or {}
        for name, one in self.inputs.items():
            key = name if name == keys.STEP else (keys.AGENTS, name)
            if f"next_{name}" in self.outputs:
                size = (*place.shape[:-1], one.shape[-1])
                given[name] = state.get(name, np.zeros(size, np.float32))
            elif (value := tensordict.get(cast(Any, key), None)) is not None:
                given[name] = value.cpu().numpy()
            else:
                raise UserError(f"the policy reads {name!r}, which is not observed here")
        with naming(self.file, Exception):  # such as inputs of another shape
            out = dict(zip(self.outputs, self.session.run(None, given), strict=True))
        after = {name.removeprefix("next_"): v for name, v in out.items() if name != "action"}
        return torch.as_tensor(out["action"]).to(place), after


def new_run(reference: str, name: str, config: RunConfig) -> RunFolder:
    """Creates a run folder for a policy that emberlink has not trained, called `name`.

    Later commands open it by `reference`, see `open_policy`; they cannot if it is empty.
    """
    run = RunFolder.create(config, label=re.sub(r"[^\w.=+-]", "-", name))
    run.write(FOREIGN, {"name": name, "policy": reference})
    return run


def foreign_name(run: RunFolder) -> str:
    """Returns the name of a run's policy if emberlink has not trained it, else an empty text."""
    return _read(run, "name") if (run.path / FOREIGN).exists() else ""


def reference_of(run: RunFolder) -> str:
    """Returns by which text the policy of a run that `new_run` has made is opened.

    A folder from somebody else must not name code that came with it, so it is a whole path outside
    of the folder.
    """
    text = _read(run, "policy")
    file = Path(_split(text)[0] or text)
    if not text:
        why = "its policy was an object, which cannot be opened again; file.py:NAME can"
        raise UserError(f"{run.path}: {why}")
    inside = run.path.resolve() in (file.resolve(), *file.resolve().parents)
    if inside or not file.is_absolute():
        raise UserError(f"{run.path / FOREIGN}: names no policy outside of its folder: {text!r}")
    return text


def _read(run: RunFolder, key: str) -> str:
    file = run.path / FOREIGN
    with naming(file, KeyError, TypeError):
        return str(json.loads(read_text(file, MAX_YAML))[key])


def is_reference(text: str) -> bool:
    """Returns whether a text names a policy that emberlink has not trained."""
    return text.endswith((".onnx", ".py")) or (not is_name(text) and bool(_split(text)[1]))


def open_policy(text: str) -> tuple[Any, str]:
    """Returns the policy of `module:name`, `file.py:name` or `file.onnx`; see `policy.opened`.

    The second result is FILE:NAME or FILE.onnx with the whole path, by which it is opened again. A
    UserError if there is no such file, module or name.
    """
    if text.endswith(".onnx"):
        return OnnxPolicy(Path(text)), str(Path(text).absolute())
    place, name = (text, "") if text.endswith(".py") else _split(text)
    module = _module(place)
    if not callable(policy := getattr(module, name, None)) or inspect.isclass(policy):
        known = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise UserError(f"{text}: expected {place}:NAME of a function; known: {', '.join(known)}")
    return policy, f"{Path(str(module.__file__)).absolute()}:{name}"


def _split(text: str) -> tuple[str, str]:
    """Returns the file or module and the name of `module:name`; an empty name if it is neither."""
    place, _, name = text.rpartition(":")
    is_module = all(part.isidentifier() for part in place.split("."))
    return (place, name) if name.isidentifier() and (place[-3:] == ".py" or is_module) else ("", "")


def _module(place: str) -> Any:
    """Imports a module of the working folder, or a file, which may import the files beside it."""
    is_file = place.endswith(".py")
    if is_file and not Path(place).is_file():
        raise UserError(f"{place}: there is no such file")
    folder = str(Path(place).absolute().parent) if is_file else ""  # as with python FILE or -m
    sys.path.insert(0, folder)
    try:
        if not is_file:
            return importlib.import_module(place)
        spec: Any = importlib.util.spec_from_file_location(place, place)
        module = importlib.util.module_from_spec(spec)
        sys.modules[place] = module  # where dataclasses look for it
        spec.loader.exec_module(module)
        return module
    except ModuleNotFoundError as error:
        if f"{place}.".startswith(f"{error.name}."):  # a module that it imports is its own mistake
            raise UserError(f"{place}: {error}") from None
        raise
    finally:
        sys.path.remove(folder)


def takes_state(policy: Callable[..., Any]) -> bool:
    """Returns whether a function, or a module's `forward`, has a second argument, None at first."""
    call = policy.forward if isinstance(policy, nn.Module) else policy
    second = [*inspect.signature(call).parameters.values()][1:2]
    by_place = [one for one in second if one.kind <= one.POSITIONAL_OR_KEYWORD]
    return any(one.default is None or one.default is one.empty for one in by_place)
