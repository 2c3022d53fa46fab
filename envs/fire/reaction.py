"""Generates fires from the heat equation: temperature and fuel (Mandel and others 2008).

The heat of the fire diffuses, the wind carries it, burning fuel produces it and the air takes it
away:

    dT/dt = k ΔT - v·∇T + A (S exp(-B/(T - Ta)) - C (T - Ta)),  dS/dt = -C_S S exp(-B/(T - Ta))

T is the temperature, S the fraction of the fuel that is left. A cell burns while it is hotter than
`ignition` and has more than `residual_fuel` of its fuel: its arrival is the first time at which
that is true, its burn-out the first time after it at which it is not.

Differences in space are central where the wind carries heat less than 2 k / |v| from node to node,
and upwind by added diffusion elsewhere. Time steps are Heun's, short enough that each stage is a
mean of neighbours with positive weights. Temperature and fuel therefore stay positive and finite.
"""

import math
from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

import torch
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass
from torch import Tensor
from torch.nn.functional import pad

from emberlink.envs.config import BASE_SIDE
from emberlink.envs.fire.level_set import nodes
from emberlink.envs.fire.ranges import FireRanges
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, Range

Reaction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""from temperature rise and fuel to their rates of change"""

_NODES_PER_FRONT = 1.5  # along the thickness of a front
_THICKNESS = (0.2, 10.0)  # of a front, cells
_MAX_NODES = 200_000  # computed together, so that the data fits in the processor's cache
_COURANT = 0.9
_MAX_CHANGE = 0.2  # of a time step, part of the reaction's shortest time
_Wind = Annotated[float, Field(ge=0, le=10)]
_Kelvin = Annotated[float, Field(ge=200, le=3000)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ReactionConfig(FireRanges):
    """A distribution of fires of the heat equation: a pair is the range of a uniform draw."""

    drawn: ClassVar[tuple[str, ...]] = (
        *("wind_speed", "azimuth", "wind_shift"),
        *("centre_x", "centre_y", "core_radius", "ring_width"),
    )
    burn_time: ClassVar[float] = math.inf
    """Burn-out follows from the equation."""
    kind: Literal["reaction"]
    """Distinguishes it from other scenarios."""
    cell_size: Annotated[float, Field(gt=0, le=1000)]
    """Side of a cell of a 30-cell side, m."""
    step_duration: Annotated[float, Field(gt=0, le=3600)]
    """Duration of a step, s."""
    diffusivity: Annotated[float, Field(ge=1e-4, le=1e4)]
    """k: diffusion of heat, m²/s."""
    heating: Annotated[float, Field(ge=1e-2, le=1e5)]
    """A: rise of temperature by burning at the greatest rate, K/s."""
    activation: Annotated[float, Field(ge=1, le=1e5)]
    """B: rise of temperature at which fuel burns at 1/e of the greatest rate, K."""
    cooling: Annotated[float, Field(ge=0, le=1)]
    """C: loss of heat to the air, in parts of `heating`, 1/K."""
    fuel_loss: Annotated[float, Field(ge=1e-5, le=100)]
    """C_S: greatest rate at which fuel burns, 1/s."""
    ambient: _Kelvin
    """Ta: temperature of the air, K."""
    ignition: _Kelvin
    """Temperature above which a cell with fuel counts as burning, K."""
    initial: _Kelvin
    """Temperature of the ring at step 0, K."""
    residual_fuel: Annotated[float, Field(gt=0, lt=1)]
    """Fraction of the fuel at which a cell is burnt out."""
    wind_speed: Range[_Wind]
    """Speed at which the wind carries the heat of the fire, m/s."""

    @property
    def thickness(self) -> float:
        """Returns how far heat diffuses while fuel burns at its highest temperature, m."""
        inertia = math.exp(min(self.activation * self.fuel_loss / self.heating, 20))
        return math.sqrt(self.diffusivity * inertia / self.fuel_loss)

    @property
    def rate(self) -> float:
        """Returns the greatest rate of the reaction, 1/s."""
        growth = 4 * math.exp(-2) * self.heating / self.activation  # max of A d/dT exp(-B/T)
        return max(self.fuel_loss, growth, self.heating * self.cooling)

    @model_validator(mode="after")
    def _check(self) -> "ReactionConfig":
        if not self.ambient < self.ignition <= self.initial:
            raise UserError(
                f"ignition={self.ignition:g}: expected a temperature above ambient="
                f"{self.ambient:g} and at most initial={self.initial:g}"
            )
        low, high = (self.thickness / bound for bound in reversed(_THICKNESS))
        if not low <= self.cell_size <= high:
            raise UserError(
                f"cell_size={self.cell_size:g}: expected {low:.3g} to {high:.3g} m; with these "
                f"coefficients a front is {self.thickness:.3g} m thick"
            )
        fastest = max(self.rate, self.wind_speed[1] / self.cell_size)
        if self.step_duration * fastest > 1:
            raise UserError(
                f"step_duration={self.step_duration:g}: expected at most {1 / fastest:.3g} s with "
                "these coefficients and this wind"
            )
        return self


def arrhenius(config: ReactionConfig) -> Reaction:
    """Returns the reaction of a scenario."""

    def rates(rise: Tensor, fuel: Tensor) -> tuple[Tensor, Tensor]:
        # exp(-40) is 0 beside 1, and exp is several times slower for numbers that underflow.
        burnt = fuel * torch.exp(-config.activation / rise.clamp_min(config.activation / 40))
        return config.heating * (burnt - config.cooling * rise), -config.fuel_loss * burnt

    return rates


def advance(
    rise: Tensor,
    fuel: Tensor,
    reaction: Reaction,
    wind: tuple[Tensor, Tensor],
    diffusivity: float,
    spacing: float,
    step: float,
) -> tuple[Tensor, Tensor]:
    """Returns temperature rise and fuel after a time step of Heun's method.

    Args:
        rise: T - Ta at the nodes, [fires, NX, NY]. No heat diffuses across the edges.
        fuel: [fires, NX, NY].
        reaction: rates of change of both.
        wind: (x, y) components at the start and at the end of the step, [fires, 2] each, m/s.
        diffusivity: m²/s.
        spacing: of the nodes, m.
        step: s.
    """
    first = _rates(rise, fuel, reaction, wind[0], diffusivity, spacing)
    middle = rise + step * first[0], fuel + step * first[1]
    second = _rates(*middle, reaction, wind[1], diffusivity, spacing)
    return (
        (rise + middle[0]).add_(second[0], alpha=step).div_(2),
        (fuel + middle[1]).add_(second[1], alpha=step).div_(2),
    )


def _rates(
    rise: Tensor, fuel: Tensor, reaction: Reaction, wind: Tensor, k: float, spacing: float
) -> tuple[Tensor, Tensor]:
    """Returns the rates of change of temperature and fuel, 1/s."""
    heat, loss = reaction(rise, fuel)
    carried = wind[:, :, None, None].unbind(1)
    wide = pad(rise, (1, 1, 1, 1), mode="replicate")
    sides = (wide[:, :-2, 1:-1], wide[:, 2:, 1:-1]), (wide[:, 1:-1, :-2], wide[:, 1:-1, 2:])
    for speed, (before, after) in zip(carried, sides, strict=True):
        spread = (speed.abs() * (spacing / 2)).clamp_min(k) / spacing**2
        half = speed / (2 * spacing)
        heat.addcmul_(before, spread + half).addcmul_(after, spread - half)
        heat.addcmul_(rise, -2 * spread)
    return heat, loss


def time_step(config: ReactionConfig, spacing: float) -> float:
    """Returns a time step, s, with which temperature and fuel stay positive."""
    spread = max(config.diffusivity, config.wind_speed[1] * spacing / 2) / spacing**2
    diffusion = 4 * spread + config.heating * config.cooling
    return min(_COURANT / diffusion, _MAX_CHANGE / config.rate)


def reaction_fires(
    config: ReactionConfig, seeds: Tensor, grid: tuple[int, int], horizon: int
) -> Tensor:
    """Returns the arrival and burn-out times of one fire per seed.

    Args:
        seeds: int64 [fires], on the device where to compute.
        grid: (X, Y) cells.
        horizon: steps. Later times are inf. A longer horizon continues the same fires.

    Returns:
        float32 [fires, 2, X, Y], steps: first arrival, then burn-out. inf is never.
    """
    cell = config.cell_size * BASE_SIDE / min(grid)
    refine = math.ceil(_NODES_PER_FRONT * cell / config.thickness)
    border = math.ceil(4 * config.thickness / cell)  # cells outside, so that heat can leave
    count = math.prod((side + 2 * border) * refine for side in grid)
    parts = seeds.split(max(1, _MAX_NODES // count))
    return torch.cat([_burn(config, part, grid, horizon, refine, border) for part in parts])


def _burn(
    config: ReactionConfig,
    seeds: Tensor,
    grid: tuple[int, int],
    horizon: int,
    refine: int,
    border: int,
) -> Tensor:
    """Computes the fires of some seeds together; see `reaction_fires`."""
    draw = {name: config.draw(name, seeds)[:, 0] for name in config.drawn}
    spacing = config.cell_size * BASE_SIDE / min(grid) / refine
    step = time_step(config, spacing)
    start, turning = draw["azimuth"].deg2rad(), draw["wind_shift"].deg2rad()
    reaction = arrhenius(config)

    def wind(time: float) -> Tensor:
        angle = start + turning * (time / config.step_duration / 1000)
        return draw["wind_speed"][:, None] * torch.stack([angle.cos(), angle.sin()], 1)

    rise, fuel = _ring(config, draw, grid, refine, border)
    inner = slice(border * refine, -border * refine, refine)
    cells = (slice(None), inner, inner)
    hot, left = config.ignition - config.ambient, config.residual_fuel
    margins = torch.minimum((rise[cells] - hot) / hot, fuel[cells] - left)
    arrival = torch.where(margins > 0, 0.0, math.inf)
    gone = torch.full_like(arrival, math.inf)
    for k in range(math.ceil(horizon * config.step_duration / step)):
        winds = wind(k * step), wind((k + 1) * step)
        rise, fuel = advance(rise, fuel, reaction, winds, config.diffusivity, spacing, step)
        now = torch.minimum((rise[cells] - hot) / hot, fuel[cells] - left)
        time = (k + margins / (margins - now)) * (step / config.step_duration)
        arrival = torch.where((margins <= 0) & (now > 0) & arrival.isinf(), time, arrival)
        gone = torch.where((margins > 0) & (now <= 0) & gone.isinf(), time, gone)
        margins = now
    times = torch.stack([arrival, gone], 1)
    return times.masked_fill(times > horizon, math.inf)


def _ring(
    config: ReactionConfig, draw: dict[str, Tensor], grid: tuple[int, int], refine: int, border: int
) -> tuple[Tensor, Tensor]:
    """Returns temperature rise and fuel at step 0: a hot ring whose inside is burnt out."""
    x, y = (nodes(side, border, refine, draw["centre_x"].device) for side in grid)
    scale = min(grid) / BASE_SIDE
    wide = {name: draw[name][:, None, None] for name in draw}
    along_x = x[:, None] - wide["centre_x"] * (grid[0] - 1)
    along_y = y - wide["centre_y"] * (grid[1] - 1)
    inside = wide["core_radius"] * scale - torch.hypot(along_x, along_y)
    # From the outer to the inner edge the fuel decreases from all to none that burns.
    depth = inside / (wide["ring_width"] * scale)
    fuel = torch.where(depth > 1, 0.0, 1 - (1 - config.residual_fuel) * depth.clamp(0, 1))
    rise = ((depth >= 0) & (depth <= 1)) * (config.initial - config.ambient)
    return rise, fuel
