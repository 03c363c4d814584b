"""The environment for reinforcement learning, by the checker of Gymnasium, and the law beside none."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

EXAMPLE = Path(__file__).parents[2] / "examples/environment.py"


@pytest.mark.system
@pytest.mark.filterwarnings("ignore:.*alternative render modes.*")
def test_the_environment_is_one_and_its_law_is_better_than_none():
    example = runpy.run_path(str(EXAMPLE))
    check_env(example["Pointing"](), skip_render_check=True)
    idle, law = (example["flown"](law) for law in (lambda counts: np.zeros(2, np.float32), example["middle_of_events"]))
    assert law > 0.7 * idle  # both are negative
    assert example["flown"](example["middle_of_events"]) == law
