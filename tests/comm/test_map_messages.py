"""Tests what UAVs tell each other with method `maps` against a scalar implementation."""

import pytest
import torch
from scalar_maps import Teller

from emberlink.comm._messages import (
    CellMessages,
    cell_bytes,
    offers,
    pass_on_places,
    place_bytes,
    place_gain,
    said_within,
)
from emberlink.envs.world.coverage_map import View
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


@pytest.mark.parametrize(
    ("horizon", "cell", "position"), [(1000, 5, 16), (65_535, 5, 16), (65_536, 7, 18)]
)
def test_steps_above_65535_take_four_bytes(horizon, cell, position):
    assert (cell_bytes(horizon), place_bytes(horizon)) == (cell, position)


def talk(messages, known, places, links, limit) -> list:
    """Lets all UAVs talk, and returns the bytes of cells and of positions, [envs, n] each."""
    near, hears = links
    stamp, place = places
    news, cells, chosen = messages.compare(known, near), None, None
    if limit is not None:
        offered = offers(known, news, limit // CELL_BYTES), place_gain(stamp, near)
        area = known.last_seen.shape[-1]
        cells, chosen = said_within(limit, *offered, area, (CELL_BYTES, PLACE_BYTES))
    return [
        messages.pass_on(known, near, hears, news, cells),
        pass_on_places(stamp, place, near, hears, chosen, PLACE_BYTES),
    ]


@pytest.mark.parametrize("limit", [None, 4, 5, 16, 23, 60])
@pytest.mark.parametrize(("density", "loss"), [(0.3, 0.0), (0.8, 0.4)])
def test_exchange_matches_reference(limit, density, loss):
    known = Knowledge(envs=ENVS, uavs=UAVS, area=AREA, horizon=4 * STEPS + 3, fires=True)
    messages = CellMessages(ENVS, UAVS, AREA, CELL_BYTES)
    stamp, place = torch.full((ENVS, UAVS, UAVS), -1), torch.zeros(ENVS, UAVS, UAVS, 3)
    own = torch.arange(UAVS)
    tellers = [Teller(UAVS) for _ in range(ENVS)]
    said_any = torch.zeros(2)
    for step in range(1, STEPS):
        view, code = looks(step)
        known.see(view, 4 * step + code)
        messages.saw(view)
        stamp[:, own, own], place[:, own, own] = step, 10.0 * step + own[:, None].float()
        linked = links(step, density, loss)
        sent = talk(messages, known, (stamp, place), linked, limit)
        for env, teller in enumerate(tellers):
            for uav in range(UAVS):
                seen = view.in_view[env, uav]
                cells = (view.cells[env, uav][seen] - env * AREA).tolist()
                codes = code[env, uav][seen].tolist()
                teller.see(uav, dict(zip(cells, codes, strict=True)), step)
            counts = teller.talk(*(x[env].tolist() for x in linked), limit, area=AREA)
            expected = torch.tensor(counts).T * torch.tensor([[CELL_BYTES], [PLACE_BYTES]])
            assert torch.stack([x[env] for x in sent]).equal(expected), (step, env)
            said_any += expected.sum(1)
            check_knowledge(teller, known, stamp, place, env)
    bytes_left = 10**9 if limit is None else limit
    assert (said_any > 0).tolist() == [bytes_left >= CELL_BYTES, bytes_left >= PLACE_BYTES]


def check_knowledge(teller, known, stamp, place, env) -> None:
    """Checks that the UAVs of an environment have the teller's maps."""
    for uav in range(UAVS):
        last = {
            cell: (number // 4, number % 4)
            for cell, number in enumerate(known.last_seen[env, uav].tolist())
            if number >= 0
        }
        assert last == teller.looks[uav]
        assert set(known.seen_fire[env, uav].nonzero().flatten().tolist()) == teller.fires[uav]
        for other in range(UAVS):
            step = teller.places[uav].get(other, -1)
            assert stamp[env, uav, other] == step
            if step >= 0:
                assert (place[env, uav, other] == 10.0 * step + other).all()
