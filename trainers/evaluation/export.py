"""Writes the policy of a run as an ONNX file, with a card of its inputs and outputs."""

import json
import logging
import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.export import Dim

from emberlink.envs.utils.atomic_io import created, new_file
from emberlink.envs.utils.errors import UserError, require
from emberlink.trainers.build import make_env
from emberlink.trainers.evaluation.foreign import FOREIGN, METADATA
from emberlink.trainers.evaluation.policy import TrainedPolicy, load
from emberlink.trainers.evaluation.scores import LEARNED, means
from emberlink.trainers.runs.checkpoint import read_header, versions
from emberlink.trainers.runs.run_folder import MAX_JSON, read_text

MEANING = {
    "observation": "see env.observation_scale; the order of docs/environment.md",
    "step": "steps since the episode began; where it is 0, the memory begins empty",
    "memory": "next_memory of the decision before, late messages included; 0 at the first",
    "hears": "whether a UAV (row) hears another one (column) in this step",
    "crops": "pictures of each UAV's own map, bytes",
    "window": "cells around each UAV: new fire, old fire, no fire",
    "action": "displacement along x, y and z in units of env.displacement cells, -1 to 1",
    "next_memory": "memory of the next decision",
}
"""the content of each input and output, by name"""


class Decision(nn.Module):
    """Maps the tensors that a policy reads at a decision to the tensors that it writes."""

    def __init__(self, policy: TrainedPolicy):
        super().__init__()
        self.policy: Any = policy.decision

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        td = TensorDict({}, batch_size=tensors[0].shape[:1])
        for key, tensor in zip(self.policy.in_keys, tensors, strict=True):
            td.set(key, tensor)
        out = self.policy(td)
        return tuple(out.get(key) for key in self.policy.out_keys)


def export(run: str | PathLike[str], file: str | Path) -> tuple[Path, Path]:
    """Writes the policy of a run as FILE.onnx, and a card as FILE.json; returns both.

    Raises:
        UserError: there is no such run, a file exists, or the extra `export` is not installed.
    """
    path = new_file(Path(file), (".onnx",))
    card_path = new_file(path.with_suffix(".json"), (".json",))
    require("onnxscript", "export", "export")
    policy = load(run, device="cpu")
    if policy.checkpoint.name == FOREIGN:
        raise UserError(f"{run}: has no networks of emberlink to export")
    decision = Decision(policy)
    fire = torch.full(policy.config.env.grid, torch.inf)
    start = make_env(policy.config, num_envs=3, fire=fire, seed=0).reset()
    example, card = tuple(start.get(key) for key in decision.policy.in_keys), card_of(policy)
    grows = policy.config.env.num_uavs if card["any_team"] else None
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # of operators of packages not used
    with warnings.catch_warnings(action="ignore", category=FutureWarning):  # of torch's own code
        program: Any = torch.onnx.export(
            decision.eval(),
            example,
            dynamo=True,
            verbose=False,
            input_names=list(card["inputs"]),
            output_names=list(card["outputs"]),
            dynamic_shapes=(tuple(_dynamic(x, grows) for x in example),),
        )
    program.model.metadata_props[METADATA] = json.dumps(card)
    with created(path) as partial:
        program.save(partial)
    with created(card_path) as partial:
        partial.write_text(json.dumps(card, indent=1) + "\n")
    return path, card_path


def _dynamic(tensor: Tensor, grows: int | None) -> dict[int, Any]:
    """Returns the open dimensions: environments, and UAVs if a team of `grows` UAVs may grow."""
    return {
        place: Dim.DYNAMIC
        for place, size in enumerate(tensor.shape[:3])
        if place == 0 or (size == grows and (place == 1 or tensor.dtype == torch.bool))
    }


def card_of(policy: TrainedPolicy) -> dict[str, Any]:
    """Returns facts for the user of an exported policy, as plain values."""
    file, card = policy.checkpoint.with_name("eval.json"), policy.card
    results = json.loads(read_text(file, MAX_JSON))["results"] if file.exists() else {}
    for name, about in card["inputs"].items():
        about["meaning"] = MEANING.get(name, "")
    return card | {
        "outputs": {name: MEANING.get(name, "") for name in card["outputs"]},
        "checkpoint": {"file": policy.checkpoint.name, "step": read_header(policy.checkpoint).step},
        "scores": {fire: means(policies[LEARNED]) for fire, policies in results.items()},
        "versions": versions(),
    }
