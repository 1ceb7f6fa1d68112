"""A real target whose dots are off, through a real tank (tests/data/real, MIT licence): the right values are its own
drawing's."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from implicam.calibrators import ForwardGP
from implicam.dataset import Dataset, read_dataset
from implicam.evaluation import evaluate

REAL = Path(__file__).parent / "data" / "real"


@cache
def two_sided_tank() -> Dataset:
    return read_dataset(REAL / "two-sided-tank")


@pytest.mark.slow
@pytest.mark.parametrize("z", [-16.0, -8.0, 0.0])
def test_error_bars_hold_away_from_the_planes_of_few_dots(z: float) -> None:
    data = two_sided_tank()
    left_out = data.xyz[:, 2] == z
    found = evaluate(ForwardGP().fit(data.select(~left_out)), data.select(left_out)).coverage.overall
    assert found.level(0.95).ellipsoid.value >= 0.85
    assert 0.5 < found.nees.value < 5


@pytest.mark.slow
def test_dots_that_are_off_are_not_taken_for_heavy_tails_of_the_pixels() -> None:
    train, _ = two_sided_tank().split(45, seed=1)  # tails would gain 32 nats, the dots 10
    fitted = ForwardGP().fit(train).fitted
    assert fitted.tails is None
    assert fitted.position_errors is not None
    sd = np.sqrt(np.diag(fitted.position_errors.scale))
    assert sd[2] > 3 * max(sd[0], sd[1])  # in depth
