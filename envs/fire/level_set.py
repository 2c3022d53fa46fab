"""Computes fronts that spread by Huygens' principle: a batched level set, [fires, X, Y].

Every point of a front emits an elliptical wavelet. The envelope of the wavelets is the next front
(Huygens; for wildfire Richards 1990, Int. J. Numer. Methods Eng. 30, and Finney 1998, FARSITE,
RMRS-RP-4). The same front is the zero contour of φ with

    φ_t + m · (u·∇φ + c (w·∇φ) + sqrt(a² (w·∇φ)² + b² (w⊥·∇φ)²)) = 0

where w is the unit vector of the direction of maximum spread, (a, b, c) the rates at which the
wavelet's half length and half breadth grow and its centre moves, u the drift of the medium (none
for fire, the current for oil on water), and m ≥ 0 a multiplier in space (fuel; 0 is a barrier).
Space is discretised by upwind differences limited by superbee (Roe 1986, Annu. Rev. Fluid Mech.
18), time by Heun's method at a Courant number of 0.4.

Conventions: cell (i, j) has its centre at x = i, y = j; lengths are in cells, times in steps,
rates in cells per step. An azimuth is in radians, counter-clockwise from the +x axis, and is the
direction in which the head moves (not the direction from which a wind comes).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from emberlink.envs.utils.errors import UserError

Varying = Tensor | Callable[[float], Tensor]
"""A value per fire, [fires] (a drift: [fires, 2]), or a function from the time in steps to one."""

Distance = Callable[[Tensor, Tensor], Tensor]
"""From x [1, NX, 1] and y [1, 1, NY] to the signed distance [fires, NX, NY], negative inside."""

COURANT = 0.4
_PAD = 2  # cells around the grid, so that the ends of the stencil lie outside of it


MAX_LENGTH_TO_BREADTH = 8.0


def length_to_breadth(wind: float | Tensor) -> Tensor:
    """Returns the length-to-breadth ratio of a wildfire in wind (Anderson 1983, USDA INT-305).

    Args:
        wind: mid-flame wind speed in m/s, not negative, any shape.

    Returns:
        0.936 exp(0.2566 U) + 0.461 exp(−0.1548 U) − 0.397, at most 8, in the shape of `wind`.
    """
    speed = torch.as_tensor(wind)
    if (speed < 0).any():
        raise UserError(f"wind speed must not be negative, got {speed.min().item()}")
    ratio = 0.936 * torch.exp(0.2566 * speed) + 0.461 * torch.exp(-0.1548 * speed) - 0.397
    return ratio.clamp(1.0, MAX_LENGTH_TO_BREADTH)


def ellipse_rates(
    head_ros: float | Tensor, length_to_breadth: float | Tensor, two_sided: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the rates of the ellipse of a point source, which lies in one of its foci.

    Args:
        head_ros: rate of the head, cells per step.
        length_to_breadth: at least 1, broadcast against `head_ros`.
        two_sided: whether the source lies in the centre, so that the back is as fast as the head.

    Returns:
        (a, b, c): growth of the half length, of the half breadth, and speed of the centre.
    """
    head, ratio = torch.as_tensor(head_ros), torch.as_tensor(length_to_breadth)
    if (ratio < 1).any():
        raise UserError(f"length_to_breadth must be at least 1, got {ratio.min().item()}")
    if two_sided:
        return head, head / ratio, torch.zeros_like(head)
    eccentricity = torch.sqrt(ratio**2 - 1) / ratio
    back = head * (1 - eccentricity) / (1 + eccentricity)
    a = (head + back) / 2
    return a, a / ratio, (head - back) / 2


def disc(centre: Tensor, radius: Tensor) -> Distance:
    """Returns the signed distance to circles: `centre` [fires, 2] and `radius` [fires], cells."""

    def distance(x: Tensor, y: Tensor) -> Tensor:
        cx, cy = centre[:, 0, None, None], centre[:, 1, None, None]
        return torch.sqrt((x - cx) ** 2 + (y - cy) ** 2) - radius[:, None, None]

    return distance


def arrival_times(
    distance: Distance,
    grid: tuple[int, int],
    head_ros: Varying,
    length_to_breadth: Varying,
    azimuth: Varying,
    *,
    horizon: float,
    two_sided: bool = False,
    drift: Varying | None = None,
    margin: int = 0,
    refine: int = 2,
    rate_field: Tensor | None = None,
    max_rate: float | None = None,
    max_step: float = math.inf,
    device: torch.device | str | None = None,
) -> Tensor:
    """Computes when a front that starts at `distance` = 0 arrives at the centre of each cell.

    Args:
        distance: the initial front, such as `disc`.
        grid, horizon: (X, Y) in cells, and steps.
        head_ros, length_to_breadth, azimuth, two_sided: the wavelet, as in `ellipse_rates`.
        drift: velocity of the medium, cells per step. The first arrival at a cell counts.
        margin: cells around the grid that are computed too; a drift can carry the front back.
        refine: nodes per cell and axis.
        rate_field: multiplier of all rates, [fires, X, Y] or [1, X, Y], linear in between. A cell
            with 0 never burns and lets nothing through.
        max_rate: upper bound of (head rate + speed of the drift) · multiplier, cells per step;
            needed if `head_ros` or `drift` is a function.
        max_step: upper bound of a time step, for functions that vary faster than the front moves.
        device: of the computation.

    Returns:
        [fires, X, Y], steps: 0 where the front is at the start, inf where it does not arrive.
    """
    pad = _PAD + margin
    x, y = (_nodes(cells, pad, refine, device) for cells in grid)
    phi = distance(x[None, :, None], y[None, None, :])
    rates = None if rate_field is None else _refined(rate_field.to(phi), grid, x, y)
    step = COURANT / refine / max(_rate_bound(head_ros, drift, rates, max_rate), 1e-12)
    wave = _Wave(head_ros, length_to_breadth, azimuth, two_sided, drift, rates, refine)
    return _march(phi, wave, pad * refine, horizon, min(step, max_step))


class _Wave(NamedTuple):
    """The rates of a front on the fine nodes."""

    head_ros: Varying
    length_to_breadth: Varying
    azimuth: Varying
    two_sided: bool
    drift: Varying | None
    rates: Tensor | None
    """multiplier of the rates at the nodes"""
    refine: int
    """nodes per cell and axis"""

    def decay(self, phi: Tensor, time: float) -> Tensor:
        """Returns −φ_t at a time."""

        def now(value: Varying) -> Tensor:
            return (value(time) if callable(value) else value).to(phi)

        wavelet = ellipse_rates(now(self.head_ros), now(self.length_to_breadth), self.two_sided)
        drift = None if self.drift is None else now(self.drift)
        decay = _hamiltonian(phi * self.refine, wavelet, now(self.azimuth), drift)
        return decay if self.rates is None else decay * self.rates


def _march(phi: Tensor, wave: _Wave, border: int, horizon: float, step: float) -> Tensor:
    """Returns the arrival times at the cells of a level set advanced by Heun's method (RK2)."""
    inner = slice(border, -border, wave.refine)
    cells = (slice(None), inner, inner)
    blocked = torch.zeros_like(phi[cells], dtype=torch.bool)
    if wave.rates is not None:
        blocked = blocked | (wave.rates[cells] <= 0)
    arrival = torch.where((phi[cells] <= 0) & ~blocked, 0.0, math.inf).to(phi)
    for k in range(math.ceil(min(horizon / step, 1e9))):
        first = wave.decay(phi, k * step)
        second = wave.decay(phi - step * first, (k + 1) * step)
        new = phi - step / 2 * (first + second)
        old, now = phi[cells], new[cells]
        crossed = (old > 0) & (now <= 0) & arrival.isinf()
        arrival = torch.where(crossed, (k + old / (old - now)) * step, arrival)
        phi = new
    return arrival.masked_fill(arrival > horizon, math.inf)


def _nodes(cells: int, pad: int, refine: int, device: torch.device | str | None) -> Tensor:
    """Returns the fine nodes of one axis; every `refine`-th is the centre of a cell."""
    count = (cells - 1 + 2 * pad) * refine + 1
    return torch.arange(count, device=device, dtype=torch.float32) / refine - pad


def _rate_bound(
    head_ros: Varying, drift: Varying | None, rates: Tensor | None, max_rate: float | None
) -> float:
    if max_rate is not None:
        return max_rate
    still = drift is None
    if not isinstance(head_ros, Tensor) or not (still or isinstance(drift, Tensor)):
        which = "drift" if isinstance(head_ros, Tensor) else "head_ros"
        raise UserError(f"max_rate is needed when {which} is a function, got None")
    fastest = float(head_ros.max() if still else (head_ros + drift.norm(dim=1)).max())
    return fastest * (1.0 if rates is None else max(float(rates.max()), 0.0))


def _refined(field: Tensor, grid: tuple[int, int], x: Tensor, y: Tensor) -> Tensor:
    """Returns the multiplier at the nodes: bilinear, 0 on barriers, their edges and corners."""
    free = (field > 0).to(field)
    u, v = x.clamp(0, grid[0] - 1), y.clamp(0, grid[1] - 1)

    def at(values: Tensor, i: Tensor, j: Tensor) -> Tensor:
        return values[:, i.long()][:, :, j.long()]

    def between(values: Tensor) -> Tensor:
        along_x, along_y = (u - u.floor())[:, None], v - v.floor()
        low = torch.lerp(at(values, u.floor(), v.floor()), at(values, u.ceil(), v.floor()), along_x)
        high = torch.lerp(at(values, u.floor(), v.ceil()), at(values, u.ceil(), v.ceil()), along_x)
        return torch.lerp(low, high, along_y)

    smooth = between(field) / between(free).clamp_min(1e-6)
    for i in ((u - 0.5).ceil(), (u + 0.5).floor()):
        for j in ((v - 0.5).ceil(), (v + 0.5).floor()):
            smooth = smooth * at(free, i, j)
    return smooth


def _hamiltonian(
    phi: Tensor,
    wavelet: tuple[Tensor, Tensor, Tensor],
    azimuth: Tensor,
    drift: Tensor | None,
) -> Tensor:
    """Computes −φ_t at unit multiplier and node spacing, upwind of ∂H/∂∇φ plus the drift."""
    a, b, c = (r[:, None, None] for r in wavelet)
    wx, wy = torch.cos(azimuth)[:, None, None], torch.sin(azimuth)[:, None, None]

    def velocity(px: Tensor, py: Tensor) -> tuple[Tensor, Tensor]:
        along, across = wx * px + wy * py, wx * py - wy * px
        norm = torch.sqrt((a * along) ** 2 + (b * across) ** 2).clamp_min(1e-12)
        head_on, sideways = c + a**2 * along / norm, b**2 * across / norm
        return wx * head_on - wy * sideways, wy * head_on + wx * sideways

    x_left, x_right, px = _differences(phi)
    y_left, y_right, py = (d.mT for d in _differences(phi.mT))
    vx, vy = velocity(px, py)
    ux, uy = (0.0, 0.0) if drift is None else drift[..., None, None].unbind(1)
    dx = torch.where(vx + ux > 0, x_left, x_right)
    dy = torch.where(vy + uy > 0, y_left, y_right)
    # In its medium a front never moves backwards, although limited differences of opposite signs
    # could give that. The medium itself may carry it back.
    decay = (vx * dx + vy * dy).clamp_min(0)
    return decay if drift is None else decay + (ux * dx + uy * dy)


def _differences(phi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns left, right (second order, limited) and central differences along axis 1."""
    first, last = phi[:, 1:2] - phi[:, :1], phi[:, -1:] - phi[:, -2:-1]
    inner = phi[:, 1:] - phi[:, :-1]
    delta = torch.cat([first, first, inner, last, last], 1)  # d[k] lies between k−2 and k−1
    slope = _superbee(delta[:, :-1], delta[:, 1:])
    bend = (slope[:, 1:] - slope[:, :-1]) / 2
    left, right = delta[:, 1:-2], delta[:, 2:-1]
    return left + bend[:, :-1], right - bend[:, 1:], (left + right) / 2


def _superbee(left: Tensor, right: Tensor) -> Tensor:
    """Returns the limited slope of two neighbouring differences: 0 if their signs differ."""
    l_abs, r_abs = left.abs(), right.abs()
    size = torch.maximum(torch.minimum(2 * l_abs, r_abs), torch.minimum(l_abs, 2 * r_abs))
    return torch.where(left * right > 0, torch.copysign(size, left), 0.0)
