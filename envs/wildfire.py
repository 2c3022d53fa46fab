"""The wildfire environment: glue between fire, motion, view and reward."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from emberlink.envs.config import WildfireConfig
from emberlink.envs.rendering import frame
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.buffers import Buffers
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.utils.errors import UserError
from emberlink.envs.world import motion
from emberlink.envs.world.coverage_map import CoverageMap
from emberlink.envs.world.reward import view_reward
from emberlink.envs.world.sensor import Sensor

from . import keys, specs
from .scenarios import ScenarioConfig, load_fires


class WildfireEnv(Buffers, EnvBase):
    """A team of UAVs over a spreading fire, batched over environments.

    Args:
        num_envs: environments that run side by side; the batch size is [num_envs].
        config: the world and the team.
        fire: a scenario's name, its config (training fires are drawn anew at each reset), or
            arrival times in steps, inf where it never burns: [X, Y] for all environments or
            [num_envs, X, Y] for one each.
        seed: of everything random here. Environment i's randomness depends on (seed, i) alone.
            Several seeds share the environments out between them, in order: each has as many, and
            they are what they would be with that seed alone.
        device: where all tensors live.

    Raises:
        ValueError: an unknown scenario, arrival times whose shape does not fit, or a number of
            environments that the seeds cannot share out.
    """

    _low: Tensor
    _high: Tensor
    _seed_key: Tensor
    _episode: Tensor
    _episode_key: Tensor
    _step_key: Tensor
    _time: Tensor
    _position: Tensor
    _seen: Tensor

    def __init__(
        self,
        num_envs: int = 1,
        config: WildfireConfig | None = None,
        fire: str | ScenarioConfig | Tensor = "paper",
        seed: int | Sequence[int] = 0,
        device: torch.device | str = "cpu",
    ):
        if num_envs < 1:
            raise UserError(f"num_envs={num_envs}: at least 1 is needed")
        seeds = list(seed) if isinstance(seed, Sequence) else [int(seed)]
        if min(seeds, default=-1) < 0:
            raise UserError(f"seed={seed}: a number that is not negative is needed")
        if num_envs % len(seeds):
            raise UserError(f"num_envs={num_envs} is no multiple of the {len(seeds)} seeds")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        if config is None:
            config = WildfireConfig()
            if isinstance(fire, Tensor) and fire.ndim in (2, 3):
                config = WildfireConfig(grid=(fire.shape[-2], fire.shape[-1]))
        self.config = config
        low, high = motion.corners(config.low, config.high)
        self.register_buffer("_low", low, persistent=False)
        self.register_buffer("_high", high, persistent=False)
        sensor = Sensor(config.grid, view_angle=config.view_angle, ceiling=high[2].item())
        fires, self._fire_each = load_fires(fire, config, num_envs)
        self._map = CoverageMap(
            sensor, fires, horizon=config.horizon, envs=num_envs, uavs=config.num_uavs
        )
        for name in ("_seed_key", "_episode", "_episode_key", "_step_key", "_time", "_seen"):
            self.register_buffer(name, torch.zeros(num_envs, dtype=torch.int64))
        position = torch.zeros(num_envs, config.num_uavs, 3, dtype=torch.float64)
        self.register_buffer("_position", position)
        team = num_envs, config.num_uavs
        self._side = sensor.side if config.observation == "window" else None
        self.observation_spec = specs.observation_spec(*team, self._side)
        self.action_spec = specs.action_spec(*team)
        self.reward_spec = specs.reward_spec(*team)
        self.done_spec = specs.done_spec(num_envs)
        self.to(self.device)
        self.set_seed(seeds[0])
        each = [counter_rng.seed_keys(one, num_envs // len(seeds), self.device) for one in seeds]
        self._seed_key.copy_(torch.cat(each))

    @property
    def fire_map(self) -> Tensor:
        """The paper's map, uint8 [num_envs, X, Y]: 0 no fire, 1 seen, 2 not yet seen."""
        burning = self.arrival_time <= self._time[:, None, None]
        return burning.to(torch.uint8) * (2 - self._map.seen.to(torch.uint8))

    @property
    def arrival_time(self) -> Tensor:
        """The fire of each environment: arrival times in steps, float32 [num_envs, X, Y]."""
        return self._map.arrival_time

    def render(self, mode: str = "rgb_array", *, env: int = 0):
        """A picture of one environment in the paper's colours, uint8 [height, width, 3].

        Raises:
            ValueError: another mode than "rgb_array".
        """
        if mode != "rgb_array":
            raise UserError(f"render mode {mode!r} is not known; known: 'rgb_array'")
        return frame.frame(
            self.fire_map[env].cpu().numpy(),
            self._position[env].cpu().numpy(),
            view_angle=self.config.view_angle,
        )

    def _set_seed(self, seed: int | None) -> None:
        count = self.batch_size[0]
        self._seed_key.copy_(counter_rng.seed_keys(seed or 0, count, self.device))
        self._episode.zero_()

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        """New positions and a new fire where "_reset" says so, else everywhere.

        Keyword Args:
            position: start positions in cells, [num_envs, num_uavs, 3] or [num_uavs, 3], in
                place of random ones.
        """
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self._time, dtype=torch.bool) if mask is None else mask.view(-1)
        self._begin_episodes(mask)
        start = self._start_positions(kwargs.get("position"))
        self._position.copy_(torch.where(mask[:, None, None], start, self._position))
        # Nobody has looked yet: the first step counts what is in view.
        nothing = torch.zeros_like(self._position, dtype=torch.int64)
        nowhere = nothing.new_zeros((*nothing.shape, 2), dtype=torch.float32)
        inside = torch.zeros_like(nothing, dtype=torch.bool)
        return self._snapshot(self._position.float(), nothing, nowhere, inside, self._unseen())

    def _unseen(self) -> Tensor | None:
        """Returns the window of UAVs that have not looked: bool [num_envs, n, 3, W, W], False."""
        if self._side is None:
            return None
        shape = *self._position.shape, self._side, self._side
        return torch.zeros(shape, dtype=torch.bool, device=self.device)

    def _begin_episodes(self, mask: Tensor) -> None:
        """Starts the next episode where a mask, bool [num_envs], is true."""
        self._episode.add_(mask)
        self._episode_key.copy_(counter_rng.fold_in(self._seed_key, self._episode))
        self._step_key.copy_(counter_rng.fold_in(self._episode_key, Use.STEPS))
        self._time.masked_fill_(mask, 0)
        self._seen.masked_fill_(mask, 0)
        self._map.start_episodes(mask, self._draw_fire())

    def _draw_fire(self) -> Tensor:
        envs, fires = self.batch_size[0], len(self._map)
        if self._fire_each:
            return torch.arange(envs, device=self.device) % fires
        unit = counter_rng.uniform(
            counter_rng.fold_in(self._episode_key, Use.EPISODE_FIRE), 1
        ).squeeze(-1)
        return (unit.double() * fires).long()

    def _start_positions(self, given: Tensor | None) -> Tensor:
        if given is None:
            key = counter_rng.fold_in(self._episode_key, Use.START_POSITION)
            return motion.random_points(key, self.config.num_uavs, self._low, self._high)
        given = torch.as_tensor(given, dtype=torch.float32, device=self.device)
        outside = (given < self._low) | (given > self._high)
        if given.shape[-2:] != self._position.shape[-2:] or outside.any() or given.isnan().any():
            raise UserError(
                f"position: {tuple(given.shape)} with values {given.min():g} to {given.max():g}; "
                f"expected [..., {self.config.num_uavs}, 3] inside the box "
                f"{self.config.low} to {self.config.high}"
            )
        return given.expand_as(self._position)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        config = self.config
        self._time.add_(1)
        position, hit_boundary = motion.move(
            self._position,
            tensordict.get(keys.ACTION),
            displacement=config.displacement,
            low=self._low,
            high=self._high,
        )
        self._position.copy_(position)
        counts, centres, classes = self._map.look(self._position, self._time.float())
        window = None if self._side is None else classes.unflatten(-1, (self._side, self._side))
        reward = view_reward(*counts.unbind(-1), hit_boundary=hit_boundary, config=config.reward)
        counts = counts.long()
        self._seen.add_(counts[..., 0].sum(-1))
        return self._snapshot(position, counts, centres, hit_boundary, window, reward)

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """TorchRL completes here what a step has left out; ours leaves nothing out."""
        return next_tensordict_out

    def _snapshot(
        self,
        position: Tensor,
        counts: Tensor,
        centres: Tensor,
        hit_boundary: Tensor,
        window: Tensor | None = None,
        reward: Tensor | None = None,
    ) -> TensorDict:
        """The TensorDict of a moment.

        Args:
            position: float32 [num_envs, n, 3].
            counts: int64 [num_envs, n, 3], cells in view that are new, old and no fire.
            centres: float32 [num_envs, n, 3, 2], their means.
            hit_boundary: bool [num_envs, n, 3].
            window: bool [num_envs, n, 3, W, W]; None where it is not observed.
            reward: float32 [num_envs, n]; a reset has none.
        """
        time = self._time.clone()
        new, old, none = counts.unbind(-1)
        new_centre, old_centre, _ = centres.unbind(-2)
        agents = {
            keys.OBSERVATION[1]: self._observe(position, counts, time),
            keys.POSITION[1]: position,
            keys.NEW_FIRE[1]: new,
            keys.OLD_FIRE[1]: old,
            keys.NO_FIRE[1]: none,
            keys.NEW_CENTRE[1]: new_centre,
            keys.OLD_CENTRE[1]: old_centre,
            keys.HIT_BOUNDARY[1]: hit_boundary,
        }
        if window is not None:
            agents[keys.WINDOW[1]] = window
        if reward is not None:
            agents[keys.REWARD[1]] = reward.unsqueeze(-1)
        truncated = (time >= self.config.horizon).unsqueeze(-1)
        whole = {
            keys.AGENTS: _tensordict(agents, position.shape[:-1], self.device),
            keys.RNG_KEY: self._step_key.clone(),
            keys.STEP: time,
            keys.SEEN: self._seen.clone(),
            keys.BURNING: self._map.count_burning(time),
            "done": truncated,
            "terminated": torch.zeros_like(truncated),
            "truncated": truncated.clone(),
        }
        return _tensordict(whole, self.batch_size, self.device)

    def _observe(self, position: Tensor, counts: Tensor, time: Tensor) -> Tensor:
        """x, y, z, new-fire flag, old-fire flag, timestep: float32 [num_envs, n, 6]."""
        clock = time.view(-1, 1, 1).expand(-1, position.shape[1], 1)
        if self.config.observation_scale == "box":
            position = motion.scale_to_box(position, self._low, self._high)
            clock = clock / self.config.horizon
        return torch.cat((position, counts[..., :2] > 0, clock), -1)


def _tensordict(source: dict, batch_size: torch.Size, device: torch.device | None) -> TensorDict:
    """A TensorDict of tensors whose shapes and device are known to be right.

    Checking them one by one takes a quarter of a step of one environment.
    """
    return TensorDict._new_unsafe(source, batch_size=batch_size, device=device)
