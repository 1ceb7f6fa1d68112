"""What a calibration can do is asked of protocols, never of a concrete class."""

import ast
from pathlib import Path

import pytest

import implicam
import implicam as ic
from implicam.calibrators import METHODS, HasPositionProcesses, PredictsPixels
from implicam.calibrators.protocol import FitSummary, per_axis

SOURCE = Path(implicam.__file__).parent
CONCRETE = {part.__name__: part.__module__ for pair in METHODS.values() for part in pair}
"""Class of a method -> the module that it is in."""

AXES = per_axis([1, 2, 3])


def asked_classes(tree):
    """(line, class) of each isinstance and issubclass."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("isinstance", "issubclass"):
            for part in ast.walk(node.args[1]):
                name = getattr(part, "id", getattr(part, "attr", ""))
                if name in CONCRETE:
                    yield node.lineno, name


def test_no_module_asks_for_the_calibrator_or_calibration_of_another_method():
    found = []
    for path in sorted(SOURCE.rglob("*.py")):
        module = ".".join(["implicam", *path.relative_to(SOURCE).with_suffix("").parts])
        for line, name in asked_classes(ast.parse(path.read_text())):
            home = CONCRETE[name].removesuffix(".calibration")
            if module != home and not module.startswith(f"{home}."):
                found.append(f"{module}:{line} {name}")
    assert not found, "ask a protocol of calibrators/protocol.py instead"


def test_the_check_finds_what_it_looks_for():
    text = "isinstance(x, ForwardGPCalibration | None)\nissubclass(y, (int, calibrators.InverseGP))\nisinstance(x, int)"
    assert list(asked_classes(ast.parse(text))) == [(1, "ForwardGPCalibration"), (2, "InverseGP")]


@pytest.mark.parametrize(
    ("more", "how", "table"),
    [
        ({}, "each left out in turn is predicted from the rest", {}),
        ({"views_rejected": 0}, "each left out in turn is predicted from the rest", {"views_rejected": 0}),
        ({"held_out": "corners are measured"}, "corners are measured", {"held_out": "corners are measured"}),
        (
            {"held_out_points": 4, "held_out_in_95": 0.5},
            "the 4 of them that it was not trained on are predicted",
            {"held_out_points": 4, "held_out_in_95": 0.5},
        ),
    ],
)
def test_a_summary_says_what_the_method_says_and_no_more(more, how, table):
    summary = FitSummary(points_used=9, points_unused=0, leave_one_out_rms=AXES, leave_one_out_mean_sd=AXES, **more)
    assert summary.how == how
    always = {"points_used": 9, "points_unused": 0, "leave_one_out_rms": AXES, "leave_one_out_mean_sd": AXES}
    assert summary.as_table() == {**always, **table}


def test_asking_for_a_protocol_reads_no_property():
    # On Python 3.11 `isinstance` evaluates every property of a protocol; `notes` alone took 10 ms of each active step.
    calibration = ic.ForwardGP().fit(ic.simulated("stereo", points=20, seed=1))
    assert isinstance(calibration, PredictsPixels)
    assert not isinstance(calibration, HasPositionProcesses)
    assert not isinstance(None, PredictsPixels)
    assert "diagnosis" not in vars(calibration), "its notes were computed"
