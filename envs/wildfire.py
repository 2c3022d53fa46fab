"""The wildfire environment: it joins fire, motion, sensor and reward, and names its tensors."""

import secrets
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvBase
from torchrl.envs.utils import make_composite_from_td

from emberlink.envs import keys, metrics
from emberlink.envs.config import WildfireConfig
from emberlink.envs.scenarios import ScenarioConfig, default_config, load_fires
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import check_device
from emberlink.envs.world import motion
from emberlink.envs.world.coverage_map import CoverageMap, Sighting
from emberlink.envs.world.failures import draw_failures
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.measures import Measures
from emberlink.envs.world.reward import step_reward
from emberlink.envs.world.sensor import Sensor

_DONE = ("done", "terminated", "truncated")


class WildfireEnv(EnvBase):
    """A team of UAVs over a spreading fire, batched over environments.

    Args:
        num_envs: number of environments; the batch size is [num_envs].
        config: constants of the world and the team.
        fire: a scenario's name, its config (each reset draws one of its training fires), or arrival
            times in steps, inf where a cell never burns: [X, Y] for all environments or [num_envs,
            X, Y] for one each; or arrival and burn-out times, [1, 2, X, Y] or [num_envs, 2, X, Y].
        seed: of all random numbers; the first reset draws a fresh one if None. Environment i's
            randomness depends on (seed, i) alone. Several seeds have equal shares of the
            environments, in order; each is the same as with its seed alone.
        device: where all tensors live.
        hold: steps for which a call of `step` holds its action; the reward is the sum over them.
        true_map: whether the map is written under `keys.TRUE_MAP`.

    Raises:
        UserError: an unknown scenario or device, arrival times whose shape does not fit, seeds or a
            number of environments that are not whole, a number of environments that is no multiple
            of the number of seeds, or a horizon that is no multiple of `hold`.
    """

    _low: Tensor
    _high: Tensor
    _seed_key: Tensor
    _episode: Tensor
    _episode_key: Tensor
    _step_key: Tensor
    _time: Tensor
    _position: Tensor
    _fail_step: Tensor

    def __init__(
        self,
        num_envs: int = 1,
        config: WildfireConfig | None = None,
        fire: str | ScenarioConfig | Tensor = "paper",
        seed: int | Sequence[int] | None = None,
        device: torch.device | str = "cpu",
        *,
        hold: int = 1,
        true_map: bool = False,
    ):
        if num_envs < 1:
            raise UserError(f"num_envs={num_envs}: expected at least 1")
        check_device(str(device))
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.config = default_config(fire) if config is None else config
        self.hold = hold
        if self.hold < 1 or self.config.horizon % self.hold:
            raise UserError(
                f"hold={hold}: expected a divisor of the horizon, {self.config.horizon} steps"
            )
        self._shows_map = true_map
        self._steer: Callable[[TensorDictBase], TensorDictBase] | None = None
        self._communicate: Callable[..., Any] | None = None
        self._fire_name = fire if isinstance(fire, str) else getattr(fire, "name", None)
        self._make_world(fire)
        torch.nn.Module.to(self, self.device)  # EnvBase.to does nothing for its own device
        self._make_specs()
        self._seeded = False
        if seed is not None:
            self._set_seed(seed)

    def _make_world(self, fire: str | ScenarioConfig | Tensor) -> None:
        """Registers the buffers: constants, and the state of all environments."""
        config, num_envs = self.config, self.num_envs
        low, high = motion.corners(config.low, config.high)
        self.register_buffer("_low", low, persistent=False)
        self.register_buffer("_high", high, persistent=False)
        sensor = Sensor(config)
        self._side = sensor.side
        fires, self._one_fire_each = load_fires(fire, config, num_envs)
        own, team = config.knowledge == "own", {"envs": num_envs, "uavs": config.num_uavs}
        self._map = CoverageMap(sensor, fires, horizon=config.horizon, own=own, **team)
        measured = config.measures == "all" or config.base is not None
        self._measures = Measures(config, num_envs, sensor.area) if measured else None
        for name in ("_seed_key", "_episode", "_episode_key", "_step_key", "_time"):
            self.register_buffer(name, torch.zeros(num_envs, dtype=torch.int64))
        never = torch.full((num_envs, config.num_uavs), torch.iinfo(torch.int64).max)
        self.register_buffer("_fail_step", never)
        position = torch.zeros(num_envs, config.num_uavs, 3, dtype=torch.float64)
        self.register_buffer("_position", position)

    def _make_specs(self) -> None:
        """Declares the tensors that the environment reads and writes; see `keys`."""
        agents, first = (self.num_envs, self.n_agents), self._first_time_step()
        self.observation_spec = make_composite_from_td(first.exclude(*_DONE))
        self.done_spec = make_composite_from_td(first.select(*_DONE))
        action = Bounded(-1.0, 1.0, torch.Size((*agents, 3)), dtype=torch.float32)
        uavs = Composite({keys.ACTION[1]: action}, shape=agents)
        self.action_spec = Composite({keys.AGENTS: uavs}, shape=agents[:1])
        first.set(keys.REWARD, torch.zeros(*agents, 1, device=self.device))
        earned = first.select(keys.REWARD)
        if self.hold > 1:
            # Not observed: they belong to the transition, and a reset has none.
            every = first.select(*metrics.counted(self.config)).unsqueeze(1)
            earned.set(keys.STEPS, every.expand(self.num_envs, self.hold))
        self.reward_spec = make_composite_from_td(earned)

    def load_state_dict(self, *args: Any, **kwargs: Any):
        """Restores a state, its seeds included; see `torch.nn.Module.load_state_dict`."""
        self._seeded = True
        return super().load_state_dict(*args, **kwargs)

    def _set_seed(self, seed: int | Sequence[int] | None) -> None:
        seed = secrets.randbelow(2**62) if seed is None else seed
        seeds = counter_rng.check_seeds(seed, self.num_envs)
        each = self.num_envs // len(seeds)
        parts = [counter_rng.seed_keys(number, each, self.device) for number in seeds]
        self._seed_key.copy_(torch.cat(parts))
        self._episode.zero_()
        self._seeded = True

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, position: Tensor | None = None
    ) -> TensorDictBase:
        """Starts an episode in the environments that "_reset" names, else in all.

        Keyword Args:
            position: start positions in cells, [num_envs, num_uavs, 3] or [num_uavs, 3]; random by
                default.
        """
        if not self._seeded:
            # Not before the first reset: copies of an unseeded environment draw their own seeds.
            self._set_seed(None)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self._time, dtype=torch.bool) if mask is None else mask.view(-1)
        self._start_episodes(mask)
        start = self._start_positions(position)
        self._position.copy_(torch.where(mask[:, None, None], start, self._position))
        if self._measures is not None and self.config.base is not None:  # spells of losses begin
            self._measures.channel(self._position, self._step_key, self._time)
        return self._first_time_step()

    def _start_episodes(self, mask: Tensor) -> None:
        """Starts the next episode where a mask, bool [num_envs], is true."""
        self._episode.add_(mask)
        self._episode_key.copy_(counter_rng.fold_in(self._seed_key, self._episode))
        self._step_key.copy_(counter_rng.fold_in(self._episode_key, Use.STEPS))
        self._time.masked_fill_(mask, 0)
        self._map.start_episodes(mask, self._draw_fire())
        if self._measures is not None:
            self._measures.start_episodes(mask, self._map)
        if self.config.failures:
            team = self.config.num_uavs, self.config.horizon
            drawn = draw_failures(self._episode_key, self.config.failures, *team)
            self._fail_step.copy_(torch.where(mask[:, None], drawn, self._fail_step))

    def _draw_fire(self) -> Tensor:
        """Returns the index of each environment's next fire, int64 [num_envs]."""
        fires = len(self._map)
        if self._one_fire_each:
            return torch.arange(self.num_envs, device=self.device) % fires
        key = counter_rng.fold_in(self._episode_key, Use.EPISODE_FIRE)
        return (counter_rng.uniform(key, 1).squeeze(-1).double() * fires).long()

    def _start_positions(self, given: Tensor | None) -> Tensor:
        """Returns start positions, float32 [num_envs, num_uavs, 3], random or as given."""
        if given is None:
            key = counter_rng.fold_in(self._episode_key, Use.START_POSITION)
            return motion.random_points(key, self.n_agents, self._low, self._high)
        return motion.given_points(given, self._position.shape, self._low, self._high)

    def join(
        self,
        steer: Callable[[TensorDictBase], TensorDictBase] | None,
        communicate: Callable[..., tuple[TensorDictBase, dict[Any, Tensor]]],
    ) -> None:
        """Calls `steer` on the action before every step, and `communicate` on successive steps.

        It gets the steps, batch size [steps, num_envs], and the last one. It returns that, and the
        tensors that it changed in all of them, [steps, num_envs, ...].
        """
        self._steer, self._communicate = steer, communicate

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Performs the steps of a held action: all at once, unless each is steered."""
        if self.hold == 1:
            step: Any = self._advance(tensordict.get(keys.ACTION), 1)[0]
            return step.update(self._measured())
        chosen, parts = tensordict.select(keys.ACTION), []
        result: Any = None
        together = self.hold if self._steer is None else 1
        for _ in range(self.hold // together):
            steered = chosen if self._steer is None else self._steer(chosen.copy())
            steps = self._advance(steered.get(keys.ACTION), together)
            parts.append(steps.select(*metrics.counted(self.config)))
            result = steps[-1]
            if self._communicate is not None:
                result, changed = self._communicate(steps, result)
                parts[-1].update(changed)
        # [envs, steps], as the time steps of a rollout are
        series: Any = torch.cat([part.transpose(0, 1) for part in parts], 1)
        result.set(keys.STEPS, series).set(keys.REWARD, series.get(keys.REWARD).sum(1))
        return result.update(self._measured())

    def _advance(self, action: Tensor, steps: int) -> TensorDict:
        """Performs steps of the world with the same action; batch size [steps, num_envs]."""
        time = self._time + torch.arange(1, steps + 1, device=self.device).unsqueeze(-1)
        alive = self._alive(time)
        moves = [self._move(action, flies) for flies in alive]
        position, hit_boundary = map(torch.stack, zip(*moves, strict=True))
        look = self._map.look(position.double(), self._step_key, time, alive)
        told, measured = None, {}
        if self._measures is not None:
            at = position, self._step_key, time, alive
            told, measured = self._measures.update(self._map, look, *at)
        new, old, none = look.counts.unbind(-1)
        penalised = self.config.reward.unseen != 0
        unseen = look.unseen.unsqueeze(-1) * alive if penalised else None
        reward = step_reward(new, old, none, hit_boundary, self.config.reward, told, unseen)
        self._time.copy_(time[-1])
        counts = look.seen, look.burning, look.burnt
        after = self._time_steps(time, position, hit_boundary, alive, look.shown, *counts)
        return after.set(keys.REWARD, reward.unsqueeze(-1)).update(measured)

    def _alive(self, time: Tensor) -> Tensor:
        """Returns which UAVs fly at steps [...], bool [..., n]."""
        return time.unsqueeze(-1) < self._fail_step

    def _move(self, action: Tensor, alive: Tensor) -> tuple[Tensor, Tensor]:
        """Moves the UAVs; returns the positions and the axes of attempted exits, see `motion`."""
        action = action.masked_fill(~alive.unsqueeze(-1), 0.0)
        box, stride = {"low": self._low, "high": self._high}, self.config.displacement
        moved, hit_boundary = motion.move(self._position, action, displacement=stride, **box)
        self._position.copy_(moved)
        return moved, hit_boundary

    def _first_time_step(self) -> TensorDict:
        """Returns the time step at which UAVs have not moved or looked yet."""
        time, position = self._time.clone(), self._position.float()
        hits = torch.zeros_like(position, dtype=torch.bool)
        nothing = Sighting.nothing(position, self._side**2)
        counts = self._map.seen_count.clone(), *self._map.count(time)
        first = self._time_steps(time, position, hits, self._alive(time), nothing, *counts)
        if self.config.reports:
            first.set(keys.REPORT_BYTES, torch.zeros_like(first.get(keys.NEW_FIRE)))
        return first.update(self._measured())

    def _time_steps(
        self,
        time: Tensor,
        position: Tensor,
        hit_boundary: Tensor,
        alive: Tensor,
        sighting: Sighting,
        seen: Tensor,
        burning: Tensor,
        burnt: Tensor,
    ) -> TensorDict:
        """Returns time steps without reward and measures, batch size [..., num_envs]."""
        counts = sighting.counts.long()
        new, old, none = counts.unbind(-1)
        new_centre, old_centre, _ = sighting.centres.unbind(-2)
        agents = {
            keys.OBSERVATION[1]: self._observe(position, counts, time),
            keys.POSITION[1]: position,
            keys.NEW_FIRE[1]: new,
            keys.OLD_FIRE[1]: old,
            keys.NO_FIRE[1]: none,
            keys.NEW_CENTRE[1]: new_centre,
            keys.OLD_CENTRE[1]: old_centre,
            keys.HIT_BOUNDARY[1]: hit_boundary,
            keys.ALIVE[1]: alive,
        }
        square = self._side, self._side
        if self.config.observation == "window":
            agents[keys.WINDOW[1]] = sighting.classes.unflatten(-1, square)
        if self.config.observation == "map":
            agents[keys.SIGHT[1]] = sighting.shown().unflatten(-1, square)
        truncated = (time >= self.config.horizon).unsqueeze(-1)
        flags = truncated, torch.zeros_like(truncated), truncated.clone()
        root = {
            keys.AGENTS: TensorDict(agents, position.shape[:-1], self.device),
            keys.RNG_KEY: self._step_key.expand(time.shape).clone(),
            keys.STEP: time,
            keys.SEEN: seen,
            keys.BURNING: burning,
            keys.BURNT: burnt,
            **dict(zip(_DONE, flags, strict=True)),
        }
        return TensorDict(root, time.shape, self.device)

    def _measured(self) -> dict[str, Tensor]:
        """Returns what no UAV knows: the measures so far, and the map."""
        measures = {} if self._measures is None else self._measures.values()
        return measures | ({keys.TRUE_MAP: self.fire_map} if self._shows_map else {})

    def _observe(self, position: Tensor, counts: Tensor, time: Tensor) -> Tensor:
        """Returns x, y, z, new-fire flag, old-fire flag and step, float32 [..., n, 6]."""
        clock = time.float()[..., None, None].expand(*position.shape[:-1], 1)
        if self.config.observation_scale == "box":
            position = motion.scale_to_box(position, self._low, self._high)
            clock = clock / self.config.horizon
        return torch.cat((position, counts[..., :2] > 0, clock), -1)

    def __repr__(self) -> str:
        config = self.config
        fire = self._fire_name or f"{len(self._map)} given"
        return (
            f"WildfireEnv(num_envs={self.num_envs}, grid={config.grid}, "
            f"num_uavs={config.num_uavs}, horizon={config.horizon}, fire={fire}, "
            f"device={self.device})"
        )

    @property
    def num_envs(self) -> int:
        """The number of environments."""
        return self.batch_size[0]

    @property
    def n_agents(self) -> int:
        """The number of UAVs in the team."""
        return self.config.num_uavs

    @property
    def max_steps(self) -> int:
        """The calls of `step` in an episode."""
        return self.config.horizon // self.hold

    @property
    def group_map(self) -> dict[str, list[str]]:
        """The UAVs' names under the key that their tensors stand under."""
        return {keys.AGENTS: [f"uav_{i}" for i in range(self.n_agents)]}

    @property
    def fire_map(self) -> Tensor:
        """The paper's map, uint8 [num_envs, X, Y]: 0 no fire, 1 seen fire, 2 unseen fire.

        A burnt-out cell is 3 if it was seen while it burned, else 4.
        """
        now = self._time[:, None, None]
        fire = (self.arrival_time <= now).to(torch.uint8) * (2 - self._map.seen.to(torch.uint8))
        if self.burn_out is not None:
            fire += 2 * (self.burn_out <= now)
        return fire

    @property
    def arrival_time(self) -> Tensor:
        """The fire of each environment: arrival times in steps, float32 [num_envs, X, Y]."""
        return self._map.arrival_time

    @property
    def burn_out(self) -> Tensor | None:
        """Burn-out times in steps, float32 [num_envs, X, Y]; None if cells burn for ever."""
        return self._map.burn_out

    @property
    def fail_step(self) -> Tensor | None:
        """The step from which each UAV has failed, int64 [num_envs, n]; None if none can fail."""
        return self._fail_step if self.config.failures else None

    @property
    def knowledge(self) -> Knowledge | None:
        """The knowledge of each UAV and, last, of the base; None in a world without a base."""
        return None if self._measures is None else self._measures.knowledge

    def render(self, mode: str = "rgb_array", *, env: int = 0):
        """Draws one environment in the paper's colours, uint8 [height, width, 3].

        Raises:
            UserError: another mode than "rgb_array".
        """
        if mode != "rgb_array":
            raise UserError(f"render mode {mode!r} is not known; known: 'rgb_array'")
        from emberlink.envs.rendering.frame import frame  # imports matplotlib

        return frame(
            self.fire_map[env].cpu().numpy(),
            self._position[env].cpu().numpy(),
            view_angle=self.config.view_angle,
            alive=self._alive(self._time)[env].cpu().numpy(),
            base=self.config.base,
        )
