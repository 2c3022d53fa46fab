"""Tests what UAVs tell each other with method `maps` against a scalar implementation."""

import pytest
import torch
from scalar_maps import Teller

from emberlink.comm import _messages
from emberlink.comm._messages import CellMessages, cell_bytes, pass_on_places, place_bytes
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.knowledge import Knowledge

ENVS, UAVS, AREA, STEPS = 3, 5, 40, 25
CELL_BYTES, PLACE_BYTES = 5, 16


def draw(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def looks(step: int) -> tuple[View, torch.Tensor]:
    """Returns what the UAVs see at a step, and the codes: the state of a cell is that of a step."""
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


def dense(known, near, hears, limit):
    most = None if limit is None else limit // CELL_BYTES
    given = known.last_seen, known.seen_fire, near, hears, most
    return _messages._pass_on_dense(*given) * CELL_BYTES


@pytest.mark.parametrize(
    ("area", "horizon", "cell", "position"),
    [
        (900, 1000, 5, 16),
        (65_536, 65_535, 5, 16),
        (65_537, 65_535, 7, 16),
        (65_536, 65_536, 7, 18),
        (512 * 512, 1_000_000, 9, 18),
    ],
)
def test_numbers_above_65535_take_four_bytes(area, horizon, cell, position):
    assert (cell_bytes(area, horizon), place_bytes(horizon)) == (cell, position)


@pytest.mark.parametrize("function", ["sparse", "dense"])
@pytest.mark.parametrize("limit", [None, 0, 23, 60])
@pytest.mark.parametrize(("density", "loss"), [(0.3, 0.0), (0.8, 0.0), (0.8, 0.4)])
def test_maps_and_bytes_equal_those_of_dictionaries(function, limit, density, loss):
    known = Knowledge(envs=ENVS, uavs=UAVS, area=AREA, horizon=4 * STEPS + 3, fires=True)
    messages = CellMessages(ENVS, UAVS, AREA, CELL_BYTES)
    tellers = [Teller(UAVS) for _ in range(ENVS)]
    said_any = 0
    for step in range(1, STEPS):
        view, code = looks(step)
        known.see(view, 4 * step + code)
        messages.saw(view)
        near, hears = links(step, density, loss)
        pass_on = dense if function == "dense" else messages.pass_on
        sent = pass_on(known, near, hears, limit)
        for env, teller in enumerate(tellers):
            for uav in range(UAVS):
                seen = view.in_view[env, uav]
                cells = (view.cells[env, uav][seen] - env * AREA).tolist()
                codes = code[env, uav][seen].tolist()
                teller.see(uav, dict(zip(cells, codes, strict=True)), step)
            budget = None if limit is None else [limit // CELL_BYTES] * UAVS
            counts = teller.talk(near[env].tolist(), hears[env].tolist(), budget)
            assert sent[env].tolist() == [CELL_BYTES * count for count in counts], (step, env)
            said_any += sum(counts)
            for uav in range(UAVS):
                last = {
                    cell: (number // 4, number % 4)
                    for cell, number in enumerate(known.last_seen[env, uav].tolist())
                    if number >= 0
                }
                assert last == teller.looks[uav], (step, env, uav)
                burnt = set(known.seen_fire[env, uav].nonzero().flatten().tolist())
                assert burnt == teller.fires[uav]
    assert (said_any > 0) == (limit != 0)


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("limit", [None, 2 * PLACE_BYTES])
def test_positions_are_passed_on_a_hop_a_step_and_the_newest_first(limit, lost):
    uavs = 4
    stamp, place = torch.full((1, uavs, uavs), -1), torch.zeros(1, uavs, uavs, 3)
    near = torch.zeros(1, uavs, uavs, dtype=torch.bool)
    for uav in range(uavs - 1):  # a chain
        near[0, uav, uav + 1] = near[0, uav + 1, uav] = True
    expected = {(uav, uav): 0 for uav in range(uavs)}
    for step in range(12):
        own = torch.arange(uavs)
        stamp[0, own, own], place[0, own, own] = step, 10.0 * step + own[:, None].float()
        expected |= {(uav, uav): step for uav in range(uavs)}
        before = dict(expected)
        left = None if limit is None else limit - 8 * (own.unsqueeze(0) % 2)  # 2 or 1 positions
        hears = near & (draw(step, uavs, uavs) < 0.6) if lost else near
        sent = pass_on_places(stamp, place, near, hears, left, PLACE_BYTES)
        for speaker in range(uavs):
            in_range = [h for h in (speaker - 1, speaker + 1) if 0 <= h < uavs]
            new = [
                k
                for k in range(uavs)
                if any(before.get((speaker, k), -1) > before.get((h, k), -1) for h in in_range)
            ]
            new.sort(key=lambda k, s=speaker: (before[s, k], k), reverse=True)
            said = new if left is None else new[: left[0, speaker] // PLACE_BYTES]
            assert sent[0, speaker] == PLACE_BYTES * len(said)
            for hearer in (h for h in in_range if hears[0, h, speaker]):
                for k in said:
                    expected[hearer, k] = max(expected.get((hearer, k), -1), before[speaker, k])
        for uav in range(uavs):
            for other in range(uavs):
                known = expected.get((uav, other), -1)
                assert stamp[0, uav, other] == known
                if known >= 0:
                    assert (place[0, uav, other] == 10.0 * known + other).all()
    if limit is None and not lost:
        assert stamp[0, 0].tolist() == [11, 11, 10, 9]


def test_pairs_are_compared_in_parts(monkeypatch):
    monkeypatch.setattr(_messages, "_COMPARED", 3)
    test_maps_and_bytes_equal_those_of_dictionaries("sparse", None, 0.8, 0.0)
