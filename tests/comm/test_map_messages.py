"""Tests what UAVs tell each other with method `maps` against a scalar implementation."""

import pytest
import torch
from scalar_maps import Teller

from emberlink.envs.config import RadioConfig
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.exchange import Exchange, cell_bytes
from emberlink.envs.world.knowledge import Knowledge

ENVS, UAVS, AREA, STEPS = 3, 5, 40, 25
CELL_BYTES, PLACE_BYTES = 5, 16


def draw(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def looks(step: int) -> tuple[View, torch.Tensor]:
    """Returns the views of the UAVs at a step, and the codes of the cells' states."""
    cells = torch.stack([draw(97 * step + k, AREA).argsort()[:6] for k in range(ENVS * UAVS)])
    cells = cells.view(ENVS, UAVS, 6)
    state = (draw(7 * step + 1, ENVS, AREA) * 3).long()
    code = state.unsqueeze(1).expand(-1, UAVS, -1).gather(2, cells)
    in_view = draw(step + 500, ENVS, UAVS, 6) < 0.8
    start = torch.arange(ENVS).view(-1, 1, 1) * AREA
    return View(cells + start, in_view, in_view & (code == 1)), code


def links(step: int, density: float, loss: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns who is in range, which mostly lasts for some steps, and who hears."""
    slow = draw(step // 4, ENVS, UAVS, UAVS) < density
    near = slow & ~torch.eye(UAVS, dtype=torch.bool) & (draw(step, ENVS, UAVS, UAVS) < 0.9)
    return near, near & (draw(step + 900, ENVS, UAVS, UAVS) >= loss) if loss else near


@pytest.mark.parametrize(("horizon", "cell"), [(1000, 5), (65_535, 5), (65_536, 7)])
def test_steps_above_65535_take_four_bytes(horizon, cell):
    assert cell_bytes(horizon) == cell


@pytest.mark.parametrize(("density", "loss"), [(0.3, 0.0), (0.8, 0.4)])
def test_exchange_matches_reference(density, loss):
    items = AREA + UAVS
    known = Knowledge(envs=ENVS, uavs=UAVS, area=items, horizon=4 * STEPS + 3, fires=True)
    sizes = torch.tensor([CELL_BYTES] * AREA + [PLACE_BYTES] * UAVS)
    messages = Exchange(RadioConfig(), sizes, (ENVS, UAVS), unit=4, free=True)
    own = AREA + torch.arange(UAVS).view(-1, 1) + items * torch.arange(ENVS).view(-1, 1, 1)
    tellers, said = [Teller(UAVS) for _ in range(ENVS)], 0
    for step in range(1, STEPS):
        view, code = looks(step)
        cells = torch.cat((view.cells + (items - AREA) * torch.arange(ENVS).view(-1, 1, 1), own), 2)
        flags = [torch.nn.functional.pad(view.in_view, (0, 1), value=True), view.burning]
        view = View(cells, flags[0], torch.nn.functional.pad(flags[1], (0, 1)))
        known.see(view, 4 * step + torch.nn.functional.pad(code, (0, 1)))
        messages.saw(view)
        linked = links(step, density, loss)
        sent, _, _ = messages(known, *linked, torch.full((ENVS,), step), None)
        for env, teller in enumerate(tellers):
            for uav in range(UAVS):
                seen = view.in_view[env, uav, :-1]
                cells = (view.cells[env, uav, :-1][seen] - env * items).tolist()
                codes = code[env, uav][seen].tolist()
                teller.see(uav, dict(zip(cells, codes, strict=True)), step)
            counts = teller.talk(*(x[env].tolist() for x in linked))
            assert sent[env].tolist() == [CELL_BYTES * c + PLACE_BYTES * p for c, p in counts]
            said += sum(map(sum, counts))
            check_knowledge(teller, known, env)
    assert said > 100


def check_knowledge(teller, known, env) -> None:
    """Checks that the UAVs of an environment have the teller's maps."""
    for uav in range(UAVS):
        last = {
            cell: (number // 4, number % 4)
            for cell, number in enumerate(known.last_seen[env, uav, :AREA].tolist())
            if number >= 0
        }
        assert last == teller.looks[uav]
        assert set(known.seen_fire[env, uav].nonzero().flatten().tolist()) == teller.fires[uav]
        for other in range(UAVS):
            step = teller.places[uav].get(other, -1)
            assert known.last_seen[env, uav, AREA + other] >> 2 == step
