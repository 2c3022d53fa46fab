"""The wildfire environment: glue between fire, motion, view and reward."""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from . import keys, render, specs, streams, uav
from .config import WildfireConfig
from .fire import FireConfig, burning_cells, load_scenario
from .fire_bank import fire_bank
from .reward import view_reward

_NEVER = torch.iinfo(torch.int32).max
_POSITIONS, _FIRE, _STEPS = range(3)  # what an episode's random stream is split into


class WildfireEnv(EnvBase):
    """A team of UAVs over a spreading fire, batched over environments.

    Args:
        num_envs: environments that run side by side; the batch size is [num_envs].
        config: the world and the team.
        fire: a scenario's name, its config (training fires are drawn anew at each reset), or
            arrival times in steps, inf where it never burns: [X, Y] for all environments or
            [num_envs, X, Y] for one each.
        seed: of everything random here. Environment i's randomness depends on (seed, i) alone.
        device: where all tensors live.

    Raises:
        ValueError: an unknown scenario, or arrival times whose shape does not fit.
    """

    # What an episode does not change ...
    _bank: Tensor
    _growth: Tensor
    _low: Tensor
    _high: Tensor
    _seed_stream: Tensor
    # ... and what it does.
    _episode: Tensor
    _fire: Tensor
    _time: Tensor
    _position: Tensor
    _seen: Tensor
    _first_seen: Tensor

    def __init__(
        self,
        num_envs: int = 1,
        config: WildfireConfig | None = None,
        fire: str | FireConfig | Tensor = "paper",
        seed: int = 0,
        device: torch.device | str = "cpu",
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs}: at least 1 is needed")
        if seed < 0:
            raise ValueError(f"seed={seed}: a number that is not negative is needed")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        if config is None:
            config = WildfireConfig()
            if isinstance(fire, Tensor) and fire.ndim in (2, 3):
                config = WildfireConfig(grid=(fire.shape[-2], fire.shape[-1]))
        self.config = config
        bank, self._fire_each = _arrivals(fire, config, num_envs)
        self.register_buffer("_bank", bank.to(self.device))
        self.register_buffer("_growth", burning_cells(self._bank, config.horizon))
        low, high = uav.corners(config.low, config.high)
        self.register_buffer("_low", low)
        self.register_buffer("_high", high)
        self._ceiling = high[2].item()
        self._make_state()
        team = num_envs, config.num_uavs
        self.observation_spec = specs.observation_spec(*team)
        self.action_spec = specs.action_spec(*team)
        self.reward_spec = specs.reward_spec(*team)
        self.done_spec = specs.done_spec(num_envs)
        self.to(self.device)
        self.set_seed(seed)

    @property
    def fire_map(self) -> Tensor:
        """The paper's map, uint8 [num_envs, X, Y]: 0 no fire, 1 seen, 2 not yet seen."""
        burning = self._bank[self._fire] <= self._time[:, None, None]
        seen = (self._first_seen < _NEVER).unflatten(-1, self.config.grid)
        return burning.to(torch.uint8) * (2 - seen.to(torch.uint8))

    @property
    def arrival(self) -> Tensor:
        """The fire of each environment: arrival times in steps, float32 [num_envs, X, Y]."""
        return self._bank[self._fire]

    def render(self, mode: str = "rgb_array", *, env: int = 0):
        """A picture of one environment in the paper's colours, uint8 [height, width, 3].

        Raises:
            ValueError: another mode than "rgb_array".
        """
        if mode != "rgb_array":
            raise ValueError(f"render mode {mode!r} is not known; known: 'rgb_array'")
        return render.frame(
            self.fire_map[env].cpu().numpy(),
            self._position[env].cpu().numpy(),
            view_angle=self.config.view_angle,
        )

    def _make_state(self) -> None:
        """What changes in an episode, and the streams that it draws from."""
        envs, uavs, (x, y) = *self.batch_size, self.config.num_uavs, self.config.grid
        self.register_buffer("_seed_stream", torch.zeros(envs, dtype=torch.int64))
        self.register_buffer("_episode", torch.zeros(envs, dtype=torch.int64))
        self.register_buffer("_fire", torch.zeros(envs, dtype=torch.int64))
        self.register_buffer("_time", torch.zeros(envs, dtype=torch.int64))
        self.register_buffer("_position", torch.zeros(envs, uavs, 3))
        self.register_buffer("_seen", torch.zeros(envs, dtype=torch.int64))
        # When and by whom a cell was first seen, as step * num_uavs + UAV: one number that
        # settles, without a loop over UAVs, who discovers a cell that several see at once.
        self.register_buffer("_first_seen", torch.full((envs, x * y), _NEVER, dtype=torch.int32))

    def _set_seed(self, seed: int | None) -> None:
        count = self.batch_size[0]
        self._seed_stream.copy_(streams.streams(seed or 0, count, self.device))
        self._episode.zero_()

    @property
    def _stream(self) -> Tensor:
        return streams.fold(self._seed_stream, self._episode)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        """New positions and a new fire where "_reset" says so, else everywhere.

        Keyword Args:
            position: start positions in cells, [num_envs, num_uavs, 3] or [num_uavs, 3], in
                place of random ones.
        """
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self._time, dtype=torch.bool) if mask is None else mask.view(-1)
        self._episode += mask
        self._time.masked_fill_(mask, 0)
        self._seen.masked_fill_(mask, 0)
        self._first_seen.masked_fill_(mask[:, None], _NEVER)
        self._fire.copy_(torch.where(mask, self._draw_fire(), self._fire))
        start = self._start_positions(kwargs.get("position"))
        self._position.copy_(torch.where(mask[:, None, None], start, self._position))
        # Nobody has looked yet: the first step counts what is in view.
        nothing = torch.zeros_like(self._position[..., 0], dtype=torch.int64)
        nowhere = torch.zeros_like(self._position[..., :2])
        return self._snapshot(
            new=nothing,
            old=nothing.clone(),
            none=nothing.clone(),
            new_centre=nowhere,
            old_centre=nowhere.clone(),
            beyond=torch.zeros_like(self._position, dtype=torch.bool),
        )

    def _draw_fire(self) -> Tensor:
        envs, fires = self.batch_size[0], len(self._bank)
        if self._fire_each:
            return torch.arange(envs, device=self.device) % fires
        unit = streams.uniform(streams.fold(self._stream, _FIRE), 1).squeeze(-1)
        return (unit.double() * fires).long()

    def _start_positions(self, given: Tensor | None) -> Tensor:
        if given is None:
            stream = streams.fold(self._stream, _POSITIONS)
            return uav.random_points(stream, self.config.num_uavs, self._low, self._high)
        given = torch.as_tensor(given, dtype=torch.float32, device=self.device)
        outside = (given < self._low) | (given > self._high)
        if given.shape[-2:] != self._position.shape[-2:] or outside.any() or given.isnan().any():
            raise ValueError(
                f"position: {tuple(given.shape)} with values {given.min():g} to {given.max():g}; "
                f"expected [..., {self.config.num_uavs}, 3] inside the box "
                f"{self.config.low} to {self.config.high}"
            )
        return given.expand_as(self._position)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        config = self.config
        self._time += 1
        position, beyond = uav.move(
            self._position,
            tensordict.get(keys.ACTION),
            displacement=config.displacement,
            low=self._low,
            high=self._high,
        )
        self._position.copy_(position)
        cells, flat, visible = uav.view(
            position, view_angle=config.view_angle, ceiling=self._ceiling, grid=config.grid
        )
        new, old = self._discover(flat, visible)
        counts = {"new": new.sum(-1), "old": old.sum(-1), "none": (visible & ~new & ~old).sum(-1)}
        self._seen += counts["new"].sum(-1)
        following = self._snapshot(
            **counts,
            new_centre=uav.mean_cell(cells, new),
            old_centre=uav.mean_cell(cells, old),
            beyond=beyond,
        )
        reward = view_reward(**counts, beyond=beyond, config=config.reward)
        following.set(keys.REWARD, reward.unsqueeze(-1))
        return following

    def _discover(self, flat: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
        """Which cells in view are new and which are old fire, bool [num_envs, n, V] each.

        UAV 0 looks first: a cell is new to the lowest UAV that sees it at the first step at
        which anyone does, and old to all others from then on.
        """
        uavs, area = self.config.num_uavs, self._first_seen.shape[-1]
        arrival = self._bank.view(-1)[self._fire[:, None, None] * area + flat]
        burning = visible & (arrival <= self._time[:, None, None])
        stamp = self._time[:, None] * uavs + torch.arange(uavs, device=self.device)
        stamp = stamp.unsqueeze(-1).to(torch.int32)
        claims = torch.where(burning, stamp, _NEVER).flatten(1)
        self._first_seen.scatter_reduce_(1, flat.flatten(1), claims, "amin")
        first = self._first_seen.gather(1, flat.flatten(1)).view_as(flat)
        return burning & (first == stamp), burning & (first < stamp)

    def _snapshot(
        self,
        *,
        new: Tensor,
        old: Tensor,
        none: Tensor,
        new_centre: Tensor,
        old_centre: Tensor,
        beyond: Tensor,
    ) -> TensorDict:
        """The TensorDict of a moment; clones, because the state is written in place."""
        position, time = self._position.clone(), self._time.clone()
        agents = TensorDict(
            {
                keys.OBSERVATION[1]: self._observe(position, new, old, time),
                keys.POSITION[1]: position,
                keys.NEW_FIRE[1]: new,
                keys.OLD_FIRE[1]: old,
                keys.NO_FIRE[1]: none,
                keys.NEW_CENTRE[1]: new_centre,
                keys.OLD_CENTRE[1]: old_centre,
                keys.BEYOND[1]: beyond,
            },
            batch_size=position.shape[:-1],
            device=self.device,
        )
        truncated = (time >= self.config.horizon).unsqueeze(-1)
        return TensorDict(
            {
                keys.AGENTS: agents,
                keys.STREAM: streams.fold(self._stream, _STEPS),
                keys.STEP: time,
                keys.SEEN: self._seen.clone(),
                keys.BURNING: self._growth[self._fire, time.clamp(max=self.config.horizon)],
                "done": truncated,
                "terminated": torch.zeros_like(truncated),
                "truncated": truncated.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _observe(self, position: Tensor, new: Tensor, old: Tensor, time: Tensor) -> Tensor:
        """x, y, z, new-fire flag, old-fire flag, timestep: float32 [num_envs, n, 6]."""
        time = time[:, None].expand_as(new).float()
        if self.config.observation == "box":
            position = uav.scale_to_box(position, self._low, self._high)
            time = time / self.config.horizon
        return torch.cat((position, torch.stack(((new > 0), (old > 0), time), -1).float()), -1)


def _arrivals(
    fire: str | FireConfig | Tensor, config: WildfireConfig, num_envs: int
) -> tuple[Tensor, bool]:
    """Arrival times, float32 [fires, X, Y], and whether environment i always has fire i."""
    if isinstance(fire, str):
        fire = load_scenario(fire)
    if isinstance(fire, FireConfig):
        return fire_bank(fire, "train", fire.bank, config.grid, config.horizon), False
    # A copy, in order in memory: what the caller does to theirs later is not our fire.
    try:
        bank = torch.as_tensor(fire, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(
            f"fire: a scenario's name, a FireConfig or arrival times, not {type(fire).__name__}"
        ) from None
    bank = bank.clone(memory_format=torch.contiguous_format)
    shape = list(bank.shape)
    bank = bank.unsqueeze(0) if bank.ndim == 2 else bank
    if bank.shape not in ((1, *config.grid), (num_envs, *config.grid)):
        raise ValueError(
            f"fire: arrival times of shape {shape}; expected {list(config.grid)} or "
            f"{[num_envs, *config.grid]} (the grid of the config, num_envs={num_envs})"
        )
    if bank.isnan().any():
        raise ValueError("fire: arrival times hold NaN; a cell that never burns is inf")
    return bank, True
