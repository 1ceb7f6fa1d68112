"""The recipe "A calibrator" of CONTRIBUTING.md, followed to the letter by two toys; every command is run with them.

`Affine` does what a calibrator must, and no more: no seed, no lens, no cameras. `AffineCameras` also predicts pixels.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any, ClassVar

import numpy as np
import pytest

import test_calibrators as contract
from command_line import Cli, Ran, cli  # noqa: F401  a fixture
from implicam import registry
from implicam.active import Budget, Loop, SimulatedOracle, Workspace
from implicam.calibrators import (
    CALIBRATORS,
    CalibrationBase,
    CalibratorBase,
    FitSummary,
    Method,
    PredictsPixels,
    Unused,
    calibrator,
)
from implicam.calibrators.every_camera import lattice_note, missing_view_reasons, pixels_of, seen_by_all
from implicam.calibrators.protocol import finite_column, option, per_axis
from implicam.dataset import Dataset, Floats, Observations
from implicam.dataset.requirements import match_cameras, require_points
from implicam.experiments import active, ball, board
from implicam.experiments.source import Source
from implicam.measurement import Measurement
from implicam.progress import Progress, silent
from implicam.rig_model import Sensitivity
from implicam.simulate import build_rig

pytestmark = pytest.mark.usefixtures("looks_kept")

# Step 1: the calibrator, a frozen dataclass


@dataclass(frozen=True)
class Affine(CalibratorBase):
    """A position is an affine function of all pixels, as wrong everywhere as at the known points."""

    ridge: float = field(default=1e-6, metadata=option("penalty of large slopes", "NUMBER"))

    method: ClassVar[str] = "affine"

    @classmethod
    def variants(cls) -> dict[str, dict[str, Any]]:
        """How stiff it is."""
        return {"stiff": {"ridge": 1e-3}}

    def fit(self, data: Dataset, progress: Progress = silent) -> AffineCalibration:
        """Least squares."""
        progress("fitting", 0, 1)
        usable, unused = seen_by_all(data, self.method)
        uv, xyz = pixels_of(usable), usable.xyz
        offset, scale = uv.mean(axis=0), float(uv.std())
        X = np.column_stack([np.ones(len(uv)), (uv - offset) / scale])
        penalty = self.ridge * len(X) * np.diag([0.0] + [1.0] * uv.shape[1])
        hat = X @ np.linalg.solve(X.T @ X + penalty, X.T)
        slopes = np.linalg.solve(X.T @ X + penalty, X.T @ xyz)
        errors = (X @ slopes - xyz) / (1 - np.minimum(np.diag(hat), 0.99))[:, None]  # each left out
        progress("fitting", 1, 1)
        return AffineCalibration(self, data, unused, offset, scale, slopes, errors)


# Step 2: the calibration


@dataclass(frozen=True, eq=False)
class AffineCalibration(CalibrationBase):
    """slopes: (1 + 2 cameras, 3); errors: (n, 3) of the known points, each left out."""

    calibrator: Affine
    data: Dataset
    unused: tuple[Unused, ...]
    offset: Floats
    scale: float
    slopes: Floats
    errors: Floats

    method: ClassVar[str] = "affine"

    def measure(self, observations: Observations) -> Measurement:
        """With every camera."""
        observations = match_cameras(self.data.observations, observations)
        n, seen = len(observations), observations.seen
        uv = observations.uv.reshape(n, len(self.offset))
        xyz = np.column_stack([np.ones(n), (uv - self.offset) / self.scale]) @ self.slopes
        cov = np.tile(self.errors.T @ self.errors / max(1, len(self.errors) - len(self.slopes)), (n, 1, 1))
        cov[~seen.all(axis=1)] = np.nan
        reasons = missing_view_reasons(seen, observations.camera_names, self.method)
        no_p_value = np.full(n, np.nan)
        return Measurement(observations.points, xyz, cov, seen.sum(axis=1), no_p_value, reasons, self.data.length_unit)

    @property
    def notes(self) -> list[str]:
        """The contract asks for this one."""
        return lattice_note(self.data, self.method)

    def summary(self) -> FitSummary:
        """Of the errors."""
        rms = per_axis(np.sqrt(np.mean(self.errors**2, axis=0)))
        return FitSummary(
            points_used=len(self.errors),
            points_unused=len(self.unused),
            leave_one_out_rms=rms,
            leave_one_out_mean_sd=rms,
        )

    def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Options, and what was learned."""
        return asdict(self.calibrator), {
            "offset": self.offset,
            "scale": np.array([self.scale]),
            "slopes": self.slopes,
            "errors": self.errors,
        }

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Mapping[str, Any]) -> AffineCalibration:
        """The inverse; every shape is checked."""
        usable, unused = seen_by_all(data, cls.method)
        d = 2 * len(data.cameras)
        return cls(
            Affine(float(table["ridge"])),
            data,
            unused,
            finite_column(arrays, "offset", (d,)),
            float(finite_column(arrays, "scale", (1,), positive=True)[0]),
            finite_column(arrays, "slopes", (1 + d, 3)),
            finite_column(arrays, "errors", (len(usable), 3)),
        )


# Step 4: what a method may do besides; this one predicts pixels


@dataclass(frozen=True)
class AffineCameras(CalibratorBase):
    """Each camera is an affine map from a position to a pixel: as seen from very far away."""

    method: ClassVar[str] = "affine-cameras"

    def fit(self, data: Dataset, progress: Progress = silent) -> AffineCamerasCalibration:
        """Least squares for each camera."""
        progress("fitting", 0, 1)
        require_points(int(data.observations.seen.all(axis=1).sum()), 6, self.method)
        progress("fitting", 1, 1)
        return AffineCamerasCalibration(self, data)


@dataclass(frozen=True, eq=False)
class AffineCamerasCalibration(CalibrationBase):
    """All of it is computed from the data when it is asked for."""

    calibrator: AffineCameras
    data: Dataset

    method: ClassVar[str] = "affine-cameras"
    unused: ClassVar[tuple[Unused, ...]] = ()
    follows_lenses_only: ClassVar[bool] = True

    @property
    def camera_names(self) -> tuple[str, ...]:
        """All of them."""
        return self.data.observations.camera_names

    @property
    def trained(self) -> Observations:
        """The data."""
        return self.data.observations

    def _cameras(self) -> list[tuple[Floats, Floats, float]]:
        """Of each camera the map (4, 2), the root of the covariance of its columns (4, 4), and the noise."""
        found = []
        for c in range(len(self.camera_names)):
            seen = self.trained.seen[:, c]
            X, uv = self._with_one(self.data.xyz[seen]), self.trained.uv[seen, c]
            map_, *_ = np.linalg.lstsq(X, uv, rcond=None)
            noise = float(np.sqrt(np.sum((X @ map_ - uv) ** 2) / (2 * len(X) - 8)))
            found.append((map_, noise * np.linalg.cholesky(np.linalg.inv(X.T @ X)), noise))
        return found

    def _with_one(self, xyz: Floats) -> Floats:
        return np.column_stack([xyz - self.data.xyz.mean(axis=0), np.ones(len(xyz))])

    def predict(self, xyz: Floats) -> Floats:
        """Every camera sees everything."""
        return np.stack([self._with_one(xyz) @ map_ for map_, *_ in self._cameras()], axis=1)

    def sensitivities(self, xyz: Floats) -> list[Sensitivity]:
        """Of each camera, which knows nothing of the others."""
        n, parts = len(xyz), []
        for c, (map_, root, noise) in enumerate(self._cameras()):
            slope = np.tile(map_[:3].T, (n, 1, 1))
            half = np.einsum("nj,kl->nkjl", self._with_one(xyz) @ root, np.eye(2)).reshape(n, 2, 8)
            parts.append(Sensitivity((c,), slope, half, np.zeros((n, 2)), np.full((n, 2), noise**2)))
        return parts

    def lines_of_sight(self, camera: str, uv: Floats) -> tuple[Floats, Floats]:
        """It is infinitely far away."""
        return np.full(3, np.nan), np.full((len(uv), 3), np.nan)

    def measure(self, observations: Observations) -> Measurement:
        """Least squares over the views there are."""
        observations = match_cameras(self.trained, observations)
        n, seen = len(observations), observations.seen
        information, right = np.zeros((n, 3, 3)), np.zeros((n, 3))
        for c, (map_, _, noise) in enumerate(self._cameras()):
            off = np.where(seen[:, c, None], observations.uv[:, c] - map_[3], 0) / noise**2
            information += seen[:, c, None, None] * (map_[:3] @ map_[:3].T) / noise**2
            right += off @ map_[:3].T
        cov, xyz = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
        enough = seen.sum(axis=1) >= 2
        cov[enough] = np.linalg.inv(information[enough])
        xyz[enough] = np.einsum("nij,nj->ni", cov[enough], right[enough]) + self.data.xyz.mean(axis=0)
        reasons = np.where(enough, "", "a position takes two cameras")
        p = np.full(n, np.nan)
        return Measurement(observations.points, xyz, cov, seen.sum(axis=1), p, reasons, self.data.length_unit)

    def summary(self) -> FitSummary:
        """Of the known points, not left out."""
        errors = self.measure(self.trained).xyz - self.data.xyz
        rms = per_axis(np.sqrt(np.nanmean(errors**2, axis=0)))
        noise = dict(zip(self.camera_names, (noise for *_, noise in self._cameras()), strict=True))
        return FitSummary(
            points_used=len(self.data), points_unused=0, held_out="the known points are measured",
            leave_one_out_rms=rms, leave_one_out_mean_sd=rms, noise_px=noise,
        )  # fmt: skip

    def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Nothing but the data."""
        return {}, {}

    @classmethod
    def from_state(cls, data: Dataset, table: Mapping[str, Any], arrays: Mapping[str, Any]) -> AffineCamerasCalibration:
        """From the data."""
        return cls(AffineCameras(), data)


# Step 3: the registry; the two ways

AFFINE = Method(Affine, AffineCalibration)


@pytest.fixture(autouse=True, params=["registered", "entry point"])
def known_methods(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CALIBRATORS, "_parts", dict(CALIBRATORS._parts))  # so that it is gone after the test
    CALIBRATORS.register("affine-cameras", Method(AffineCameras, AffineCamerasCalibration))
    if request.param == "registered":
        CALIBRATORS.register("affine", AFFINE)
    else:
        added = EntryPoints([EntryPoint("affine", f"{__name__}:AFFINE", "implicam.calibrators")])
        monkeypatch.setattr(registry, "entry_points", lambda **by: added.select(**by))


def needs_one_way(request: pytest.FixtureRequest) -> None:
    """What takes long is run for one way of registering only."""
    if "entry point" in request.node.name:
        pytest.skip("run for the other way")


def run(cli: Cli, words: str) -> Ran:
    return cli(*words.split())


@pytest.fixture
def rig(cli: Cli) -> None:
    assert run(cli, "simulate rig --cameras 2R --positions random --points 60 --check 30 --seed 1").code == 0


# Step 5: the contract


CASE = contract.Case("affine", (), 30.0, 0.05)
CONTRACT = [
    test
    for name, test in vars(contract).items()
    if name.startswith("test_") and any(mark.args[:1] == ("case",) for mark in getattr(test, "pytestmark", ()))
]


@pytest.mark.parametrize("test", CONTRACT, ids=lambda test: test.__name__)
def test_it_keeps_the_contract(test: Any, tmp_path: Any, request: pytest.FixtureRequest) -> None:
    needs_one_way(request)
    given = {"case": CASE, "tmp_path": tmp_path}
    names = test.__code__.co_varnames[: test.__code__.co_argcount]
    (more,) = [mark.args for mark in test.pytestmark if mark.name == "parametrize" and mark.args[0] != "case"] or [None]
    for value in [None] if more is None else more[1]:
        test(**{name: given.get(name, value) for name in names})


# every command


def test_every_command_that_takes_any_calibration_works(rig: None, cli: Cli) -> None:
    ran = run(cli, "calibrate rig -o a.implicam --method affine --json")
    assert ran.code == 0, ran.err
    assert ran.json["method"] == "affine"
    assert set(ran.json["residuals"]["leave_one_out_rms"]) == set("xyz")
    ran = run(cli, "calibrate rig -o b.implicam --method affine:stiff --seed 3 --points 40")
    assert ran.code == 0, ran.err
    assert "affine from 40 points" in ran.out
    assert "each left out in turn is predicted from the rest within" in ran.out
    assert "ridge = 0.001" in cli("info", "b.implicam").out
    ran = run(cli, "measure a.implicam rig/check -o m.csv --json")
    assert (ran.code, ran.json["points_measured"]) == (0, ran.json["rows"])
    assert run(cli, "evaluate a.implicam rig/check --json").json["method"] == "affine"
    assert run(cli, "evaluate rig --cv 3 --method affine --json").json["method"] == "affine"
    assert run(cli, "evaluate rig --leave-out shot --method affine --seed 2").code == 0
    assert run(cli, "evaluate a.implicam --cv 3").code == 0
    assert run(cli, "report a.implicam -o r.html").code == 0
    ran = run(cli, "compare rig --methods affine,affine:stiff,affine-cameras --train 40 --seeds 2 --json")
    assert {trial["method"] for trial in ran.json["trials"]} == {"affine", "affine:stiff", "affine-cameras"}
    assert not any(trial["failure"] for trial in ran.json["trials"])


def test_compare_takes_it_without_being_asked(rig: None, request: pytest.FixtureRequest) -> None:
    from implicam.cli.compare import _available_methods

    assert {"affine", "affine-cameras"} <= set(_available_methods())


REFUSALS = [
    ("suggest a.implicam", "affine cannot say where to measure next", "use one of forward-gp, inverse-gp, explicit"),
    ("acquire s --unattended --method affine", "affine cannot say where to measure next", "use one of forward-gp"),
    ("export a.implicam --to aniposelib -o c.toml", "affine has no cameras", "--method explicit"),
    ("detect photos --target ball --radius 8 --calibration a.implicam", "a.implicam was made by affine", "forward-gp"),
    ("calibrate rig -o x.implicam --method affine --lens none", "affine has no option 'lens'", "affine has ridge"),
    ("calibrate rig -o x.implicam --method affine:soft", "affine has no variant 'soft'", "use one of stiff"),
    ("calibrate rig -o x.implicam --method afine", "did you mean 'affine'", "affine"),
]


def test_what_it_cannot_do_is_refused_by_name_with_the_cure(rig: None, cli: Cli) -> None:
    assert run(cli, "calibrate rig -o a.implicam --method affine").code == 0
    run(cli, "simulate photos --images --cameras 2R --positions random --points 1")
    for words, what, cure in REFUSALS:
        ran = run(cli, words)
        assert ran.code in (1, 2), words
        told = " ".join(ran.err.split())
        assert what in told, words
        assert cure in told, words
        assert "Traceback" not in told, words


def test_a_file_of_a_method_that_is_gone_says_so(
    rig: None,
    cli: Cli,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert run(cli, "calibrate rig -o b.implicam --method affine-cameras").code == 0
    del CALIBRATORS._parts["affine-cameras"]
    ran = cli("info", "b.implicam")
    assert "made by the method 'affine-cameras', which this version does not have" in " ".join(ran.err.split())


# a method that predicts pixels does the rest


def test_one_that_predicts_pixels_says_where_to_measure_next(rig: None, cli: Cli) -> None:
    assert run(cli, "calibrate rig -o a.implicam --method affine-cameras").code == 0
    ran = run(cli, "suggest a.implicam -n 2 --json")
    assert ran.code == 0, ran.err
    assert len(ran.json["targets"]) == 2
    assert ran.json["now"]["usual"] > ran.json["expected"]["usual"] > 0
    ran = run(cli, "detect photos --target ball --radius 8 --calibration a.implicam")
    assert "made by affine-cameras" not in ran.err


@pytest.mark.slow
def test_one_that_predicts_pixels_guides_a_session(cli: Cli, request: pytest.FixtureRequest) -> None:
    needs_one_way(request)
    ran = run(cli, "acquire s --unattended --cameras 2R --method affine-cameras --budget 12 --json")
    assert ran.code == 0, ran.err
    assert 8 < ran.json["points"] <= 12
    assert ran.json["stopped"]
    assert cli("info", "s/calibration.implicam").code == 0


def test_the_loop_takes_it_too(request: pytest.FixtureRequest) -> None:
    needs_one_way(request)
    rig = build_rig("bar6", seed=1, cameras="2R")
    loop = Loop(
        calibrator("affine-cameras"), Workspace.from_box(rig.volume), rule=Budget(12), candidates=100, judged=50
    )
    loop = loop.run(SimulatedOracle(rig))
    assert loop.points == 12
    assert isinstance(loop.calibration, PredictsPixels)


def test_the_options_are_those_of_the_command_line() -> None:
    from implicam.calibrators import every_option

    assert json.dumps(dict(every_option()["ridge"]["affine"].metadata))


def test_the_sweeps_of_the_paper_take_it_by_its_name() -> None:
    source = Source.of(None, 0).options
    swept = [
        board.learn(source, "2R", 8, "affine"),
        ball.learn(source, "ball", "2R", "affine", 60, 2),
        active.grow(source, "2R", "affine:stiff", [0], start=40, additions=1, lot=1),
    ]
    for rows in (made["rows"] for made in swept):
        assert rows
        assert all(row["method"].startswith("affine") and not row.get("failure") and row["rmse"] > 0 for row in rows)
