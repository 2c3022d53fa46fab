"""Records pictures of an episode, or the data for drawing it."""

from collections.abc import Collection
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.rendering.marks import ROLES, FrameData
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world import radio
from emberlink.trainers.evaluation.evaluate import Watch, play


class Camera:
    """Draws the first of several environments at evenly spaced steps; `add` is called at each step.

    Args:
        horizon: steps of the episode.
        frames: largest number of pictures.

    Attributes:
        steps: the steps that are drawn.
        pictures: uint8 [height, width, 3] each.
    """

    def __init__(self, horizon: int, frames: int = 100):
        even = np.linspace(0, horizon, min(frames, horizon + 1)).round().astype(int)
        self.steps: list[int] = sorted({*even.tolist()})
        self.pictures: list[np.ndarray] = []

    def add(self, world: WildfireEnv, td: TensorDictBase) -> None:
        """Draws the environments' step if it is one of `steps`; see `Watch`."""
        if int(td.get(keys.STEP)[0]) in self.steps:
            self.pictures.append(world.render())


def watched_by(*watches: Watch) -> Watch:
    """Returns a `Watch` that calls others in turn."""

    def watch(world: WildfireEnv, td: TensorDictBase) -> None:
        for one in watches:
            one(world, td)

    return watch


def record_episode(
    env: TransformedEnv,
    policy: TensorDictModuleBase,
    *,
    steps: Collection[int],
    advised: bool,
    member: int = 0,
) -> list[FrameData]:
    """Returns the frames of one episode without exploration noise.

    Links are included if the policy or a base station receives messages.

    Args:
        env: environments with communication.
        policy: writes ("agents", "action").
        steps: steps to record, from 0 to the horizon.
        advised: whether the policy reads an output of the communication module.
        member: index of the environment to record.
    """
    frames: list[FrameData] = []

    def add(world: WildfireEnv, td: TensorDictBase) -> None:
        now: Any = td[member]
        if int(now.get(keys.STEP)) in steps:
            base = world.config.base
            told = advised and now.get(keys.HEARS, None) is not None
            listens = told or base is not None or getattr(policy, "hears", False)
            links = links_of(world.config, td[member : member + 1]) if listens else None
            frames.append(
                frame_data(now, world.fire_map[member], links=links, advised=advised, base=base)
            )

    play(env, policy, add)
    return frames


def links_of(world: WildfireConfig, td: TensorDictBase) -> Tensor:
    """Returns which radios hear each other, bool [r, r]: the UAVs, and the base last if any.

    Args:
        world: constants of the environment.
        td: output of a reset or a step of one environment, batch size [1].
    """
    position, alive = td.get(keys.POSITION).double(), td.get(keys.ALIVE)
    given = td.get(keys.RNG_KEY), td.get(keys.STEP)
    if world.base is None:
        return radio.links(world.radio, position, *given, alive=alive)[0]
    base = position.new_tensor([[[*world.base, 0.0]]])
    return radio.links_with_base(world.radio, position, base, *given, alive)[0]


def frame_data(
    td: TensorDictBase,
    fire_map: Tensor,
    *,
    links: Tensor | None,
    advised: bool,
    base: tuple[float, float] | None = None,
) -> FrameData:
    """Returns the data for drawing one environment at one step.

    Args:
        td: output of a reset or a step, batch size [].
        fire_map: uint8 [X, Y], see `WildfireEnv.fire_map`.
        links: bool [r, r], which radios hear each other; None to draw no links.
        advised: whether to draw the roles and targets that the communication module writes.
        base: place of the base station, cells; None without one.
    """
    follows = td.get(keys.FOLLOWS, None) if advised else None
    target = td.get(keys.TARGET, None) if advised else None
    return FrameData(
        step=int(td.get(keys.STEP)),
        seen=int(td.get(keys.SEEN)),
        burnt=int(td.get(keys.BURNT)),
        fire_map=_array(fire_map),
        position=_array(td.get(keys.POSITION)),
        links=None if links is None else _array(links),
        roles=None if follows is None else _array(roles(follows)),
        target=None if target is None else _array(target),
        alive=_array(td.get(keys.ALIVE)),
        base=base,
    )


def roles(follows: Tensor) -> Tensor:
    """Returns the role of each UAV as an index in `marks.ROLES`, int64 [..., n].

    Args:
        follows: int64 [..., n], the UAV that each UAV follows: itself for a discoverer, -1 for
            none.
    """
    discoverer, seeker, wanderer = range(len(ROLES))
    itself = torch.arange(follows.shape[-1], device=follows.device)
    role = torch.where(follows == itself, discoverer, seeker)
    return role.masked_fill(follows < 0, wanderer)


def _array(tensor: Tensor) -> Any:
    return tensor.cpu().numpy().copy()
