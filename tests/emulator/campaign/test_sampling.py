"""Where runs lie: strata by counting, the design of Saltelli by its definition."""

import numpy as np
import pytest

from emulator.campaign.sampling import unit_points


def test_sobol_has_one_point_in_each_stratum_and_goes_on_when_the_count_grows():
    points = unit_points("sobol", 64, 3, seed=5)
    for column in points.T:
        assert sorted((column * 64).astype(int)) == list(range(64))
    assert np.array_equal(unit_points("sobol", 40, 3, seed=5), points[:40])


def test_latin_hypercube_has_one_point_in_each_stratum():
    points = unit_points("latin-hypercube", 37, 2, seed=5)
    for column in points.T:
        assert sorted((column * 37).astype(int)) == list(range(37))


@pytest.mark.parametrize("sampling", ["sobol", "latin-hypercube", "random", "saltelli"])
def test_points_depend_on_the_seed_alone(sampling):
    one, again, other = (unit_points(sampling, 16, 2, seed) for seed in (7, 7, 8))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)
    assert one.min() >= 0
    assert one.max() < 1


def test_the_design_of_saltelli_changes_one_column_at_a_time():
    points = unit_points("saltelli", 8, 3, seed=1).reshape(8, 5, 3)
    a, b = points[:, 0], points[:, -1]
    assert not np.any(a == b)
    for k in range(3):
        assert np.array_equal(points[:, k + 1, k], b[:, k])
        others = [j for j in range(3) if j != k]
        assert np.array_equal(points[:, k + 1, others], a[:, others])
