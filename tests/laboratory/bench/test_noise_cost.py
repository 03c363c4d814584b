"""The benchmark of the cost of noise: its light and its refusals."""

import itertools

import numpy as np
import pytest

from laboratory.bench import noise_cost
from laboratory.bench.noise_cost import frames, openeb


@pytest.mark.parametrize("scene", ["grating", "edge"])
def test_rates_are_the_derivatives_of_the_light(scene):
    before, middle, after = itertools.islice(frames(scene, 1000), 9, 12)
    slope = (after.light.astype(np.float64) - before.light) / (2 * noise_cost.STEP_S)
    assert np.abs(middle.rate - slope).max() < 0.01 * np.abs(slope).max()
    assert middle.light.min() > 0
    assert middle.light.max() <= 1


def test_a_folder_that_is_no_checkout_is_refused_with_the_way_to_get_one(tmp_path):
    with pytest.raises(SystemExit, match=r"git clone https://github\.com/prophesee-ai/openeb"):
        openeb(tmp_path)
