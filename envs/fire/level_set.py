"""Computes fronts that spread by Huygens' principle: a batched level set, [fires, X, Y].

Every point of a front emits an elliptical wavelet. The envelope of the wavelets is the next front
(Huygens; for wildfire Richards 1990, Int. J. Numer. Methods Eng. 30, and Finney 1998, FARSITE,
RMRS-RP-4). The same front is the zero contour of φ with

    φ_t + m · (u·∇φ + c (w·∇φ) + sqrt(a² (w·∇φ)² + b² (w⊥·∇φ)²)) = 0

where w is the unit vector of the direction of maximum spread, (a, b, c) the rates at which the
wavelet's half length and half breadth grow and its centre moves, u the drift of the medium (none
for fire, the current for oil on water), and m > 0 a multiplier in space (fuel).
Space is discretised by upwind differences limited by superbee (Roe 1986, Annu. Rev. Fluid Mech.
18), time by Heun's method at a Courant number of 0.4.

Conventions: cell (i, j) has its centre at x = i, y = j; lengths are in cells, times in steps,
rates in cells per step. An azimuth is in radians, counter-clockwise from the +x axis, and is the
direction in which the head moves (not the direction from which a wind comes).
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

Varying = Tensor | Callable[[float], Tensor]
"""A value per fire, [fires] (a drift: [fires, 2]), or a function of the time in steps."""

Distance = Callable[[Tensor, Tensor], Tensor]
"""From x [1, NX, 1] and y [1, 1, NY] to the signed distance [fires, NX, NY], negative inside."""

COURANT = 0.4
_PAD = 2  # cells around the grid, so that the ends of the stencil lie outside of it


MAX_LENGTH_TO_BREADTH = 8.0


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
    head_ros: Tensor,
    length_to_breadth: Tensor,
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
) -> Tensor:
    """Computes when a front that starts at `distance` = 0 arrives at the centre of each cell.

    Args:
        distance: the initial front, such as `disc`.
        grid, horizon: (X, Y) in cells, and steps.
        head_ros, length_to_breadth, azimuth, two_sided: the wavelet, as in `ellipse_rates`.
        drift: velocity of the medium, cells per step. The first arrival at a cell counts.
        margin: cells around the grid that are computed too; a drift can carry the front back.
        refine: nodes per cell and axis.
        rate_field: multiplier of all rates, [fires, X, Y] or [1, X, Y], linear in between.
        max_rate: upper bound of (head rate + speed of the drift) · multiplier, cells per step; by
            default of the head rate and the multiplier, without a drift.
        max_step: upper bound of a time step, for functions that vary faster than the front moves.

    Returns:
        [fires, X, Y], steps: 0 where the front is at the start, inf where it does not arrive.
    """
    pad = _PAD + margin
    x, y = (nodes(cells, pad, refine, head_ros.device) for cells in grid)
    phi = distance(x[None, :, None], y[None, None, :])
    rates = torch.ones(()) if rate_field is None else _refined(rate_field.to(phi), grid, x, y)
    wavelet = ellipse_rates(head_ros.to(phi), length_to_breadth.to(phi), two_sided)
    if max_rate is None:
        max_rate = float(head_ros.max() * rates.max())
    step = min(COURANT / refine / max(max_rate, 1e-12), max_step)

    def decay(phi: Tensor, time: float) -> Tensor:
        """Returns −φ_t at a time."""
        towards = azimuth(time) if callable(azimuth) else azimuth
        medium = drift(time) if callable(drift) else drift
        decayed = _hamiltonian(phi * refine, wavelet, towards, medium)
        return decayed if rate_field is None else decayed * rates

    inner = slice(pad * refine, -pad * refine, refine)
    cells = (slice(None), inner, inner)
    arrival = torch.where(phi[cells] <= 0, 0.0, math.inf).to(phi)
    for k in range(math.ceil(horizon / step)):  # Heun's method (RK2)
        first = decay(phi, k * step)
        second = decay(phi - step * first, (k + 1) * step)
        new = phi - step / 2 * (first + second)
        old, now = phi[cells], new[cells]
        crossed = (old > 0) & (now <= 0) & arrival.isinf()
        arrival = torch.where(crossed, (k + old / (old - now)) * step, arrival)
        phi = new
    return arrival.masked_fill(arrival > horizon, math.inf)


def nodes(cells: int, pad: int, refine: int, device: torch.device) -> Tensor:
    """Returns the fine nodes of one axis; every `refine`-th is the centre of a cell."""
    count = (cells - 1 + 2 * pad) * refine + 1
    return torch.arange(count, device=device, dtype=torch.float32) / refine - pad


def _refined(field: Tensor, grid: tuple[int, int], x: Tensor, y: Tensor) -> Tensor:
    """Returns the multiplier at the nodes, bilinear between cells."""
    u, v = x.clamp(0, grid[0] - 1), y.clamp(0, grid[1] - 1)
    along_x, along_y = (u - u.floor())[:, None], v - v.floor()

    def at(i: Tensor, j: Tensor) -> Tensor:
        return field[:, i.long()][:, :, j.long()]

    low, high = (
        torch.lerp(at(u.floor(), j), at(u.ceil(), j), along_x) for j in (v.floor(), v.ceil())
    )
    return torch.lerp(low, high, along_y)


def _hamiltonian(
    phi: Tensor, wavelet: tuple[Tensor, Tensor, Tensor], azimuth: Tensor, drift: Tensor | None
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
