"""Tests field of view and class counts against hand-computed numbers."""

import pytest
import torch

from emberlink.envs.world.sensor import Sensor, view_radius


@pytest.mark.parametrize(("altitude", "radius"), [(1, 0.57735), (2, 1.15470), (4, 2.30940)])
def test_view_radius(altitude, radius):
    assert view_radius(altitude, 30.0) == pytest.approx(radius, abs=1e-5)
    assert view_radius(altitude, 45.0) == pytest.approx(altitude)


def seen(position, grid=(30, 20), view_angle=30.0, ceiling=4.0) -> set[tuple[int, int]]:
    view = Sensor(grid, view_angle=view_angle, ceiling=ceiling)
    names = torch.arange(grid[0] * grid[1]).view(grid)  # cell indices, -1 in the margin
    flat = view.pad(names, -1)
    assert flat.shape == (view.area,)
    assert view.crop(flat).equal(names)
    # After another map, as in a batch of environments.
    where = torch.tensor([position], dtype=torch.float64)
    centre, cells, near = view.look(where, torch.tensor([view.area]))
    assert view.area <= cells.min() <= cells.max() < 2 * view.area
    in_view = flat[cells - view.area][near]
    assert centre.tolist() == [[round(position[0]), round(position[1])]]
    in_view = in_view[in_view >= 0]
    assert len(in_view.unique()) == len(in_view)
    return {divmod(name, grid[1]) for name in in_view.tolist()}


@pytest.mark.parametrize(
    ("position", "columns", "rows"),
    [
        ([5.0, 7, 1], [5], [7]),  # radius 0.577
        ([5.5, 7, 1], [5, 6], [7]),
        ([5.4, 7.6, 1], [5], [8]),  # 6 is 0.6 away along x, 7 is 0.6 away along y
        ([5.0, 7, 4], [3, 4, 5, 6, 7], [5, 6, 7, 8, 9]),  # radius 2.309
        ([5.5, 7.3, 4], [4, 5, 6, 7], [5, 6, 7, 8, 9]),
        ([0.0, 0, 4], [0, 1, 2], [0, 1, 2]),
        ([29.0, 19, 4], [27, 28, 29], [17, 18, 19]),
        ([0.4, 18.6, 2], [0, 1], [18, 19]),
    ],
)
def test_view(position, columns, rows):
    assert seen(position) == {(i, j) for i in columns for j in rows}


def test_view_wider_than_the_grid_has_every_cell_once():
    assert len(seen([3.0, 4, 50], (8, 10), 60.0, 50.0)) == 80


def test_view_can_be_empty_between_cells():
    assert seen([5.5, 7.5, 0.5]) == set()


def test_count_classes():
    view = Sensor((30, 20), view_angle=30.0, ceiling=4.0)  # a window of 5 x 5 cells
    classes = torch.zeros(2, 3, 5, 5, dtype=torch.bool)
    classes[0, 0, 0, 4] = classes[0, 0, 1, 4] = classes[0, 0, 4, 1] = True
    classes[1, 1] = True
    centre = torch.tensor([[10.0, 7], [0, 19]], dtype=torch.float64)
    counts, means = view.count_classes(classes.flatten(-2), centre)
    assert counts.tolist() == [[3, 0, 0], [0, 25, 0]]
    # (8, 9), (9, 9) and (12, 6); then the whole window
    expected = torch.tensor([[[29 / 3, 8], [0, 0], [0, 0]], [[0, 0], [0, 19], [0, 0]]])
    assert means.equal(expected)


@pytest.mark.parametrize(("grid", "ceiling"), [((256, 256), 4.0), ((256, 200), 256.0)])
def test_count_classes_is_exact_in_a_window_of_any_size(grid, ceiling):
    view = Sensor(grid, view_angle=80.0, ceiling=ceiling)
    where = torch.tensor([[grid[0] - 1.0, 0, ceiling]], dtype=torch.float64)
    centre, cells, near = view.look(where, torch.tensor([0]))
    inside = view.pad(torch.ones(grid), 0.0)[cells] > 0
    counts, means = view.count_classes((near & inside).unsqueeze(-2), centre)
    reach = int(view_radius(ceiling, 80.0))
    columns, rows = (min(side, reach + 1) for side in grid)
    assert counts.item() == columns * rows
    assert means.flatten().tolist() == [grid[0] - (columns + 1) / 2, (rows - 1) / 2]
