"""Cameras unlike our own: pixels that are not square, mirrors, tilts, crops, wild views; right, or refused in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from implicam.calibrators import ForwardGP, load_calibration
from implicam.calibrators.forward_gp.families import family_prior
from implicam.calibrators.forward_gp.settings import DEFAULT_SETTINGS, KINDS
from implicam.dataset import Dataset, Observations, read_dataset
from implicam.evaluation import cross_validate, evaluate
from implicam.geometry import camera_from_linear, resect_affine, resect_robustly, rotation_from_vector
from implicam.lenses import PERSPECTIVE_K
from implicam.rig_model.general_camera import GeneralCamera
from implicam.simulate import Unusual, build_rig, random_positions, simulate

CASES = Path(__file__).parent / "data" / "cases"
SHEETS = CASES / "spreadsheets"


def with_pixels(data: Dataset, change: Callable[[np.ndarray], np.ndarray]) -> Dataset:
    seen = data.observations
    uv = change(seen.uv.copy())
    return replace(data, observations=Observations(seen.points, seen.cameras, uv, seen.sd))


def stretched(ratio: float) -> Dataset:
    """nonsquare-points with pixels of another shape; its own ratio is 1.067, and 0.212 mm are right at any."""

    def change(uv: np.ndarray) -> np.ndarray:
        uv[..., 1] = 359.5 + ratio / 1.067 * (uv[..., 1] - 359.5)
        return uv

    return with_pixels(read_dataset(CASES / "nonsquare-points"), change)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [pytest.param(0.75, marks=pytest.mark.slow), 1.0, 1.333])
def test_pixels_need_not_be_square(ratio: float) -> None:
    found = cross_validate(ForwardGP().fit, stretched(ratio), 5).coverage.overall
    assert found.rmse == pytest.approx(0.212, rel=0.05)
    assert found.level(0.95).pooled.value > 0.9


def sheet(change: Callable[[np.ndarray], np.ndarray] = lambda uv: uv) -> Dataset:
    return with_pixels(read_dataset(SHEETS / "known.csv", unit="m"), change)


def error_on_new(known: Dataset, change: Callable[[np.ndarray], np.ndarray] = lambda uv: uv) -> tuple[float, int]:
    """Rms error in mm on new.csv, and how many of its 200 points are measured."""
    new = with_pixels(read_dataset(SHEETS / "new.csv", unit="m"), change).observations
    truth = np.genfromtxt(SHEETS / "truth.csv", delimiter=",", names=True, dtype=None, encoding=None)
    xyz = np.column_stack([truth[axis] for axis in "xyz"])
    measured = ForwardGP().fit(known).measure(new)
    good = measured.measured
    return 1000 * float(np.sqrt(np.mean(np.sum((measured.xyz - xyz)[good] ** 2, axis=1)))), int(good.sum())


@pytest.mark.slow
@pytest.mark.parametrize("pixel", [10986.1, 30000.0])
def test_a_wild_pixel_is_rejected_and_named_though_no_image_size_is_stated(pixel: float) -> None:
    def slipped(uv: np.ndarray) -> np.ndarray:
        uv[0, 0, 0] = pixel
        return uv

    known = sheet(slipped)
    rejected = ForwardGP().fit(known).rejected
    assert (rejected[0].point, rejected[0].camera) == (known.points[0], "cam1")
    rms, measured = error_on_new(known)
    assert rms < 2.7
    assert measured >= 198


@pytest.mark.slow
def test_v_from_below_is_a_mirror_image_and_said_to_be_one() -> None:
    def upside_down(uv: np.ndarray) -> np.ndarray:
        uv[..., 1] = 1081 - uv[..., 1]
        return uv

    rms, measured = error_on_new(sheet(upside_down), upside_down)
    assert rms < 2.7
    assert measured >= 198
    assert any("mirrored" in note for note in ForwardGP().fit(sheet(upside_down)).notes)


def odd_rig(unusual: Unusual, points: int = 40, seed: int = 5, spec: str = "bar4") -> tuple[Dataset, Dataset]:
    rig = build_rig(spec, seed=seed, frame="random", unusual=unusual)
    both = simulate(rig, random_positions(rig, points + 150, np.random.default_rng(seed)), seed=seed)
    return both.select(np.arange(points)), both.select(np.arange(points, points + 150))


ODD = {
    "tilt": Unusual(tilt=8.0),
    "mirror": Unusual(mirror="cam2"),
    "all mirrored": Unusual(mirror="all"),
    "aspect": Unusual(aspect=1.4),
}


@pytest.mark.slow
@pytest.mark.parametrize("unusual", ODD.values(), ids=ODD.keys())
def test_odd_cameras_measure_as_well_as_ordinary_ones(unusual: Unusual) -> None:
    known, new = odd_rig(unusual)
    calibration = ForwardGP().fit(known)
    assert calibration.camera_names == known.observations.camera_names
    found = evaluate(calibration, new, regions=False).coverage.overall
    assert found.rmse_over_limit < 1.5
    assert found.nees.value < 5
    asked = "is an axis of the known positions negated, or are two exchanged (left-handed)?"
    assert any(asked in note for note in calibration.notes) == (unusual.mirror == "all")


def test_the_kind_is_told_stored_and_found_again(tmp_path: Path) -> None:
    known, new = odd_rig(Unusual(mirror="cam2"))
    calibration = ForwardGP().fit(known)
    told = [note for note in calibration.notes if note.startswith("cam2")]
    assert len(told) == 1
    assert "mirror" in told[0]
    calibration.save(tmp_path / "rig.implicam")
    again = load_calibration(tmp_path / "rig.implicam")
    assert again.notes == calibration.notes
    np.testing.assert_array_equal(again.measure(new.observations).xyz, calibration.measure(new.observations).xyz)
    cameras = again.state()[0]["cameras"]
    assert [one["mirrored"] for one in cameras] == [False, True, False, False]
    assert {one["lens"] for one in cameras} == {"kannala-brandt"}


@pytest.mark.slow
def test_a_fit_that_grows_keeps_the_kind() -> None:
    known, new = odd_rig(Unusual(tilt=8.0), points=60)
    first = ForwardGP().fit(known.select(np.arange(50)))
    second = first.refit_from(known)
    kinds = [[model.family for model in one.posterior.models] for one in (first, second)]
    assert kinds[0] == kinds[1]
    assert evaluate(second, new, regions=False).coverage.overall.nees.value < 5


def test_ordinary_cameras_are_called_ordinary() -> None:
    known, _ = odd_rig(Unusual(), points=25)
    calibration = ForwardGP().fit(known)
    assert {model.family for model in calibration.posterior.models} == {"ordinary"}
    assert calibration.notes == []


@pytest.mark.slow
def test_a_camera_that_saw_nonsense_does_not_take_the_rig_down() -> None:
    known, new = odd_rig(Unusual())

    def nonsense(uv: np.ndarray) -> np.ndarray:
        uv[:, 1] = np.random.default_rng(1).uniform(0, 800, size=uv[:, 1].shape)
        return uv

    calibration = ForwardGP().fit(with_pixels(known, nonsense))
    assert calibration.camera_names == ("cam1", "cam3", "cam4")
    assert any(note.startswith("cam2 is not calibrated") for note in calibration.notes)
    assert evaluate(calibration, new, regions=False).coverage.overall.nees.value < 5


@pytest.mark.parametrize("family", KINDS)
def test_every_kind_has_a_proper_prior_on_all_but_focal_length_and_pose(family: str) -> None:
    known, _ = odd_rig(Unusual())
    calibration = ForwardGP().fit(known)
    model = calibration.posterior.models[0]
    assert isinstance(model.camera, GeneralCamera)
    prior = family_prior(model.camera, family, model.image, 0.5, DEFAULT_SETTINGS)
    flat = [0, 12, 13, 14, 15, 16]
    assert not prior.precision[flat].any()
    assert (
        np.linalg.eigvalsh(prior.precision[1:12, 1:12] / np.sqrt(np.outer(*2 * [np.diag(prior.precision)[1:12]]))).min()
        > 0
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_linear_camera_comes_apart_and_together_again(sign: float) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, size=(30, 3))
    K = np.array([[sign * 800.0, 30.0, 300.0], [0.0, 900.0, 200.0], [0.0, 0.0, 1.0]])
    P = K @ np.column_stack([rotation_from_vector([0.3, -0.4, 0.2]), [0.1, 0.2, 9.0]])
    u, v, w = (np.column_stack([points, np.ones(30)]) @ P.T).T
    uv = np.column_stack([u / w, v / w])
    uv[3] += 50.0
    found, inliers = resect_robustly(points, uv)
    assert not inliers[3]
    parts = camera_from_linear(found)
    assert parts is not None
    focal, shape, centre, mirrored, pose = parts
    assert mirrored == (sign < 0)
    np.testing.assert_allclose(centre, [300.0, 200.0], atol=1e-6)
    assert focal == pytest.approx(np.sqrt(800 * 900))
    camera = GeneralCamera(focal, shape, np.zeros(2), centre, PERSPECTIVE_K, mirrored, pose)
    np.testing.assert_allclose(camera.pixel(points)[inliers], uv[inliers], atol=1e-4)


def test_a_parallel_projection_is_found_in_spite_of_wrong_views() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, size=(40, 3))
    A, b = rng.normal(size=(2, 3)), rng.normal(size=2)
    uv = points @ A.T + b
    uv[:4] += rng.uniform(3, 9, size=(4, 2))
    found = resect_affine(points, uv)
    np.testing.assert_allclose(found[0], A, atol=1e-9)
    np.testing.assert_allclose(found[1], b, atol=1e-9)
    assert not found[2][:4].any()


@pytest.mark.slow
def test_stating_the_size_of_the_images_is_the_cure_that_the_note_names() -> None:
    """Case spreadsheets: at most 2.3 mm is right; without the size the lens's middle must be learned, and is told."""
    known = sheet()
    assert any("state the size of its images (--size)" in note for note in ForwardGP().fit(known).notes)
    sized = read_dataset(SHEETS / "known.csv", unit="m", size=(1920, 1080))
    assert ForwardGP().fit(sized).notes == []
    assert error_on_new(sized)[0] <= 2.3
