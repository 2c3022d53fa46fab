"""Defines communication modules and the transform that adds one to an environment."""

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Transform

from emberlink.comm._belief import BeliefMaps
from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.plugins import Plugins
from emberlink.envs.world import radio


class CommModule(nn.Module):
    """Rewrites the UAVs' observations, such as from the messages that they receive.

    A subclass in its own file, `comm/<name>.py`, is a new communication method; the file name is
    its name.

    A module keeps its state, such as a map per UAV, in buffers of shape [num_envs, ...], which
    `forward` and `reset` write in place (`self.map.copy_(...)`). Buffers are saved with a
    checkpoint and must hold finite numbers. Constants are registered with `persistent=False`.

    If `hears` is true, the links of each step, by the radio of the world (`env.radio`), are written
    under `keys.HEARS` before `shaping` and `forward` are called. Messages over them arrive
    `env.radio.delay` steps later (`radio.Late`).

    Args:
        world: the environment's constants.
        config: an instance of `config_type`.
        num_envs: environments that run side by side.
    """

    config_type: ClassVar[type]
    """a pydantic dataclass: the settings under `comm` in a method's YAML file"""
    hears: ClassVar[bool] = False
    """whether the module reads `keys.HEARS`"""
    heeds_packets: ClassVar[bool] = False
    """whether messages heed `env.radio.delay` and `env.radio.bandwidth`; if not, they cause a
    warning"""
    every_step: bool = True
    """whether the module takes part in every step of a held action, not only at decisions; without
    it, a module neither shapes nor steers, and each step sends the bytes of the decision"""
    units: ClassVar[tuple[str, ...]] = ()
    """settings that define the observation's units; an evaluation with other values warns"""
    out_keys: ClassVar[Sequence[Any]] = (keys.OBSERVATION,)
    """the keys that `forward` writes"""
    hold: int = 1
    """steps from one decision of the policy to the next (`policy.hold`); between them, no policy
    reads observations"""
    maps: BeliefMaps | None
    """with `observation: map`, what each UAV knows: `forward` may enter what UAVs hear"""

    def __init__(self, world: WildfireConfig, config: Any, num_envs: int = 1):
        super().__init__()
        self.world, self.config, self.num_envs = world, config, num_envs
        self.maps = BeliefMaps(world, num_envs) if world.observation == "map" else None

    def specs(self, observation: Composite) -> Composite:
        """Returns the environment's observation spec, with the entries that `forward` writes."""
        return observation

    def reset(self, tensordict: TensorDictBase, mask: Tensor) -> None:
        """Starts the state of new episodes; called before the first `forward` of an episode.

        Args:
            tensordict: the first time step of the new episodes, as the environment wrote it.
            mask: bool [num_envs], the environments that begin a new episode. The state of the
                others must not change.
        """

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rewrites ("agents", "observation") of one time step and updates the state."""
        raise NotImplementedError

    def shaping(self, tensordict: TensorDictBase) -> Tensor | None:
        """Returns a term to add to the reward of a step, float32 [num_envs, n], or None.

        Called before `forward`, with the state of the previous time step.
        """
        return None

    def steer(self, tensordict: TensorDictBase) -> Tensor | None:
        """Returns the actions to perform, float32 [num_envs, n, 3]; None keeps the policy's.

        It is called before each step, with the state of the last `forward`. The learner learns from
        the action of the policy, which does not change. Scripted policies are evaluated without a
        module that defines it.

        Args:
            tensordict: has ("agents", "action"), and not always the rest of the time step.
        """
        return None

    @property
    def steers(self) -> bool:
        """Whether `steer` may return other actions."""
        return type(self).steer is not CommModule.steer

    def bytes_sent(self, tensordict: TensorDictBase) -> Tensor | None:
        """Returns the bytes that each UAV sends at a step, int64 [num_envs, n]; None for none.

        It is called after `forward`, with `measures: all` and a range above 0. A message that
        several UAVs hear counts once. UAVs that have failed send nothing, whatever is returned.
        """
        return None

    def take_part(
        self, steps: TensorDictBase, last: TensorDictBase
    ) -> tuple[TensorDictBase, Tensor | None, Tensor | None]:
        """Takes part in successive time steps, one after another, and rewrites the last one.

        A module may compute them together, with the same result.

        Args:
            steps: batch size [steps, num_envs].
            last: the last one of them, batch size [num_envs].

        Returns:
            The rewritten step; terms to add to the rewards, float32 [steps, num_envs, n], or None;
            and the bytes that each UAV sends, int64 [steps, num_envs, n], or None.
        """
        bonus, sent = [], []
        for step in successive(steps, last):
            bonus.append(self.shaping(step))
            last = self.rewrite(step)
            sent.append(self.bytes_sent(last) if self.counts else None)
        return self.show(last), _stacked(bonus), _stacked(sent)

    def rewrite(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Enters the UAVs' sightings into their maps, if they have any, and calls `forward`."""
        if self.maps is not None:
            self.maps.look(tensordict)
        return self(tensordict)

    def show(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Draws the UAVs' maps where they decide at a time step."""
        if self.maps is not None:
            self.maps.show(tensordict, tensordict.get(keys.STEP) % self.hold == 0)
        return tensordict

    @property
    def counts(self) -> bool:
        """Whether the bytes that UAVs send are measured."""
        return self.world.measures == "all" and self.world.radio.range > 0


def successive(steps: TensorDictBase, last: TensorDictBase) -> Iterator[TensorDictBase]:
    """Yields the time steps of `CommModule.take_part`, one after another."""
    for number in range(len(steps) - 1):
        yield steps[number]  # pyright: ignore[reportReturnType]
    yield last


def _stacked(parts: list[Tensor | None]) -> Tensor | None:
    return None if parts[0] is None else torch.stack([part for part in parts if part is not None])


class Communication(Transform):
    """Adds a communication module to an environment.

    It is a transform and not part of the policy, so that both observations of a transition are
    rewritten. It reads nothing from the previous time step: all state is in the module. Where the
    environment holds actions (`WildfireEnv.hold`), it calls the module at each step itself.

    Args:
        module: the communication module, built for the same number of environments.
        message_bytes: bytes that a policy's UAVs send at each decision; 0 if it has no messages.

    Raises:
        ValueError: a persistent buffer of the module does not have `num_envs` as its first
            dimension.
    """

    def __init__(self, module: CommModule, message_bytes: int = 0):
        super().__init__()
        self.module, self.message_bytes, self._joined = module, message_bytes, False
        self.listens = module.hears or message_bytes > 0
        limits = self.listens and module.world.radio.bandwidth is not None
        self._writes = [keys.HEARS] * self.listens + [keys.BUDGET] * limits
        self.channel = radio.Channel(module.world, module.num_envs)
        for name, buffer in module.state_dict().items():
            if buffer.shape[:1] != (module.num_envs,):
                raise ValueError(
                    f"{type(module).__name__}: buffer {name!r} of shape {list(buffer.shape)}; the "
                    f"first dimension of state must be num_envs={module.num_envs} (register "
                    "constants with persistent=False)"
                )

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        world: Any = None if self.parent is None else self.parent.base_env
        # Bytes of learned messages are counted at decisions, and not at every step.
        counted = self.message_bytes > 0 and self.module.world.measures == "all"
        counted |= self.module.world.reports
        spells = self.listens and self.module.world.radio.burst > 1  # which go on at every step
        takes_part = self.module.every_step or counted or spells or self.module.maps is not None
        self._joined = getattr(world, "hold", 1) > 1 and takes_part
        if self._joined:
            world.join(self._steered if self.module.steers else None, self._stepped)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        module, mask = self.module, tensordict.get("_reset", None)
        everywhere = torch.ones_like(tensordict_reset.get(keys.STEP), dtype=torch.bool)
        mask = everywhere if mask is None else mask.flatten()
        some = not mask.all()
        before = {n: buffer.clone() for n, buffer in module.state_dict().items()} if some else {}
        module.reset(tensordict_reset, mask)
        if module.maps is not None:
            module.maps.known.start_episodes(mask)
        result = self._heard(tensordict_reset)
        # The other environments are within an episode; their state must not change.
        state = module.state_dict()
        for name, old in before.items():
            began = mask.view(-1, *[1] * (old.ndim - 1))
            state[name].copy_(torch.where(began, state[name], old))
        return result

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict if self._joined else self._steered(tensordict)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._joined:
            return next_tensordict
        if not self.module.every_step:  # nothing but the observation changes
            return self._heard(next_tensordict)
        return self._stepped(next_tensordict.unsqueeze(0), next_tensordict)[0]

    def _steered(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the action to perform at a step."""
        action = self.module.steer(tensordict)
        return tensordict if action is None else tensordict.set(keys.ACTION, action)

    def _stepped(
        self, steps: TensorDictBase, last: TensorDictBase
    ) -> tuple[TensorDictBase, dict[Any, Tensor]]:
        """Communicates after successive steps of the environment, see `CommModule.take_part`.

        Returns:
            The last time step, and the entries of all steps that communication has changed,
            [steps, num_envs, ...].
        """
        self._listen(steps)
        for key in self._writes:
            last.set(key, steps.get(key)[-1])
        last, bonus, sent = self.module.take_part(steps, last)
        changed = self._bytes(steps, sent)
        if bonus is not None:
            if self.module.world.failures:
                bonus = bonus.masked_fill(~steps.get(keys.ALIVE), 0.0)
            changed[keys.REWARD] = steps.get(keys.REWARD) + bonus.unsqueeze(-1)
        for key, value in changed.items():
            last.set(key, value[-1])
        return last, changed

    def _heard(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Communicates at a time step that no reward leads to, or at which none changes."""
        module = self.module
        self._listen(tensordict)
        heard = module.show(module.rewrite(tensordict))
        sent = module.bytes_sent(heard) if module.counts else None
        return heard.update(self._bytes(heard, sent))

    def _listen(self, steps: TensorDictBase) -> None:
        """Writes the links and budgets of time steps, if the module or the policy reads them."""
        if self.listens:
            step, world = steps.get(keys.STEP), self.module.world
            at = steps.get(keys.POSITION), steps.get(keys.RNG_KEY), step
            near, hears = self.channel(*at, steps.get(keys.ALIVE) if world.failures else None)
            left = radio.budget(world, near)
            if left is not None:
                decides = step.unsqueeze(-1) % self.module.hold == 0
                left = left - self.message_bytes * decides
                steps.set(keys.BUDGET, left)
                hears = hears & (left >= 0).unsqueeze(-2)
            steps.set(keys.HEARS, hears)

    def _bytes(self, steps: TensorDictBase, sent: Tensor | None) -> dict[Any, Tensor]:
        """Returns the bytes that the UAVs send, in a world in which they are measured."""
        world = self.module.world
        if world.measures != "all":
            return {}
        alive = steps.get(keys.ALIVE)
        total = torch.zeros_like(alive, dtype=torch.int64) if sent is None else sent * alive
        if world.reports:
            total = total + steps.get(keys.REPORT_BYTES)
        if self.message_bytes and world.radio.range:
            says = alive & (steps.get(keys.STEP) % self.module.hold == 0).unsqueeze(-1)
            left = steps.get(keys.BUDGET, None)
            total = total + self.message_bytes * (says if left is None else says & (left >= 0))
        return {keys.BYTES_SENT: total}

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        if not self._joined or self.module.world.measures != "all":
            return reward_spec
        spec = reward_spec.clone()
        every = spec[keys.STEPS, keys.AGENTS]
        every[keys.BYTES_SENT[1]] = Unbounded(every.shape, device=spec.device, dtype=torch.int64)
        return spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        spec = observation_spec.clone()
        agents = spec[keys.AGENTS].shape
        if self.listens:
            pairs = torch.Size((*agents, agents[-1]))
            spec[keys.HEARS] = Binary(shape=pairs, device=spec.device, dtype=torch.bool)
        whole = Unbounded(agents, device=spec.device, dtype=torch.int64)
        if keys.BUDGET in self._writes:
            spec[keys.BUDGET] = whole.clone()
        if self.module.world.measures == "all":
            spec[keys.BYTES_SENT] = whole
        maps = self.module.maps
        return self.module.specs(spec if maps is None else maps.specs(spec))


MODULES = Plugins(CommModule, "emberlink.comm", "comm.name")
