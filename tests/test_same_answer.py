"""The same data give the same calibration file, byte for byte: in another process, whatever its hash seed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import implicam as ic
from implicam import calibration_file

MAKE = {
    "forward-gp": "ic.ForwardGP()",
    "forward-gp central": 'ic.ForwardGP(lens="central")',
    "forward-gp none": 'ic.ForwardGP(lens="none")',
    "explicit": "ic.Explicit()",
    "inverse-gp": "ic.InverseGP()",
    "inverse-gp plain": 'ic.InverseGP(preset="plain")',
    "inverse-gp coregionalised": 'ic.InverseGP(outputs="coregionalised")',
}
SLOW = {"mlp": ("torch", "ic.MLP(seed=3)"), "inverse-gp paper": ("gpytorch", 'ic.InverseGP(preset="paper")')}

FIT = """
import json
import implicam as ic
from implicam import calibration_file
known = ic.simulated("stereo", points=30, seed=1)
print(json.dumps({name: calibration_file.checksum(make().fit(known)) for name, make in {%s}.items()}))
"""


def checksums(make: dict[str, str], hash_seed: str) -> dict[str, str]:
    cases = ", ".join(f"{name!r}: lambda: {expression}" for name, expression in make.items())
    environment = os.environ | {"PYTHONHASHSEED": hash_seed}
    ran = subprocess.run(
        [sys.executable, "-c", FIT % cases], env=environment, capture_output=True, text=True, check=True
    )
    found: dict[str, str] = json.loads(ran.stdout)
    return found


def test_the_same_data_give_the_same_file_in_another_process() -> None:
    first = checksums(MAKE, "1")
    assert first == checksums(MAKE, "2")
    assert len(set(first.values())) == len(MAKE)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_so_do_the_methods_that_are_trained(name: str) -> None:
    library, expression = SLOW[name]
    if find_spec(library) is None:
        pytest.skip(f"{library} is not installed")
    assert checksums({name: expression}, "1") == checksums({name: expression}, "2")


def test_the_checksum_is_that_of_the_file(tmp_path: Path) -> None:
    made = ic.ForwardGP().fit(ic.simulated("stereo", points=30, seed=1))
    made.save(tmp_path / "rig.implicam")
    assert calibration_file.checksum(made) == calibration_file.checksum(tmp_path / "rig.implicam")
    with pytest.raises(ic.errors.CalibrationFileError, match=r"other\.implicam cannot be read"):
        calibration_file.checksum(tmp_path / "other.implicam")
