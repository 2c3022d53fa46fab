"""Writes the inventories by which API pages link to other projects, without network access."""

import zlib
from pathlib import Path

_GENERATED = "reference/generated/{name}.html#{name}"
PROJECTS = {
    "torchrl": (
        "https://docs.pytorch.org/rl/0.14/",
        {
            "torchrl.envs.EnvBase": _GENERATED,
            "torchrl.envs.TransformedEnv": _GENERATED,
            "torchrl.envs.Transform": _GENERATED,
            "torchrl.objectives.DDPGLoss": _GENERATED,
            "torchrl.objectives.TD3Loss": _GENERATED,
            "torchrl.objectives.ClipPPOLoss": _GENERATED,
        },
    ),
    "tensordict": (
        "https://docs.pytorch.org/tensordict/stable/",
        {
            "tensordict.nn.TensorDictModule": _GENERATED,
            "tensordict.nn.TensorDictSequential": _GENERATED,
            "tensordict.nn.TensorDictModuleBase": _GENERATED,
        },
    ),
    "pettingzoo": (
        "https://pettingzoo.farama.org/",
        {"pettingzoo.utils.env.ParallelEnv": "api/parallel/#{name}"},
    ),
}
"""project -> (address of its documentation, class -> page)"""


def write_inventories(folder: Path) -> dict[str, tuple[str, str]]:
    """Writes an `objects.inv` for each project and returns `intersphinx_mapping`."""
    folder.mkdir(parents=True, exist_ok=True)
    mapping = {}
    for project, (address, classes) in PROJECTS.items():
        head = f"# Sphinx inventory version 2\n# Project: {project}\n# Version: \n"
        lines = [f"{name} py:class 1 {page.format(name=name)} -" for name, page in classes.items()]
        file = folder / f"{project}.inv"
        note = "# The remainder of this file is compressed using zlib.\n"
        content = zlib.compress("".join(f"{line}\n" for line in lines).encode())
        file.write_bytes((head + note).encode() + content)
        mapping[project] = (address, str(file.resolve()))
    return mapping
