"""Every method measures what it measured when tests/make_golden.py stored it."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest

from make_golden import LIBRARY, RIGS, difference, has_library, numbers, pixels, stored

ROUNDING_SD = 1e-3
"""What another processor may change, whose sums are rounded otherwise, in standard deviations."""
FLAT_LIKELIHOOD_SD = 0.02
"""The same of inverse-gp: its likelihood is flat at the top, and the search stops elsewhere on it (2e-3 were seen)."""
OTHER_TRAINING_SD = 5.0
"""The same of a network, whose training with another version of its library may be another one."""

SLOW = {("two-sided-tank", "explicit"), ("two-sided-tank", "mlp"), ("odd", "explicit"), ("odd", "mlp")}
"""With these the test would take more than fifteen seconds of work."""
CASES = [
    pytest.param(rig, name, marks=[pytest.mark.slow] if (rig, name) in SLOW else [])
    for rig, setup in RIGS.items()
    for name in setup.methods
]


@pytest.mark.parametrize("rig", RIGS)
def test_the_rigs_are_those_of_the_stored_numbers(rig: str) -> None:
    np.testing.assert_allclose(np.array(pixels(RIGS[rig].pair())), stored(rig)["pixels"], rtol=1e-10)


@pytest.mark.parametrize(("rig", "name"), CASES)
def test_a_method_measures_what_it_measured(rig: str, name: str) -> None:
    if not has_library(name):
        pytest.skip(f"{name} is fitted with {LIBRARY[name]}")
    golden, now = stored(rig)["methods"][name], numbers(RIGS[rig].pair(), name)
    if name == "mlp":
        now["cov"] = golden["cov"]
        assert difference(golden, now) < OTHER_TRAINING_SD
    else:
        assert difference(golden, now) < (FLAT_LIKELIHOOD_SD if name.startswith("inverse-gp") else ROUNDING_SD)


def test_a_difference_is_seen() -> None:
    golden = stored("odd")["methods"]["explicit"]
    assert difference(golden, golden) == 0
    moved = deepcopy(golden)
    moved["xyz"][3][1] += 0.01 * golden["sd"][3][1]
    assert difference(golden, moved) == pytest.approx(0.01)
    wider = deepcopy(golden)
    wider["cov"][4][2] *= 1.01
    assert difference(golden, wider) == pytest.approx(0.01)
    lost = deepcopy(golden)
    lost["xyz"][0], lost["cov"][0], lost["views"][0] = [None] * 3, [None] * 6, 0
    assert difference(golden, lost) == np.inf
