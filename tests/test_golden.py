"""Every method measures what it measured when tests/make_golden.py stored it."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest

import implicam as ic
from make_golden import FILES, GOLDEN, LIBRARY, RIGS, difference, has_library, measured_by, numbers, pixels, stored

ROUNDING_SD = 1e-3
"""What another processor may change, whose sums are rounded otherwise, in standard deviations."""
FLAT_LIKELIHOOD_SD = 0.02
"""The same of inverse-gp: its likelihood is flat at the top, and the search stops elsewhere on it (2e-3 were seen)."""
OTHER_TRAINING_SD = 5.0
"""The same of a network, whose training with another version of its library may be another one."""

FROM_FILE_SD = 1e-5
"""What rounding may change where nothing is fitted."""

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


@pytest.mark.slow
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


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.implicam")), ids=lambda path: path.stem)
def test_a_calibration_file_measures_as_on_the_day_it_was_made(path: Path) -> None:
    golden = json.loads(path.with_suffix(".json").read_text())
    now = measured_by(ic.load_calibration(path), RIGS[golden["rig"]].pair()[1])
    assert difference(golden["measured"], now) < FROM_FILE_SD


def test_the_calibration_files_are_those_of_the_list() -> None:
    names = {path.stem.split("-", 1)[1] for path in GOLDEN.glob("v*.implicam")}
    assert names == {f"{rig}-{name}" for rig, name in FILES}


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
