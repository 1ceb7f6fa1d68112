"""One contract for the settings of every method: documented, in the file, the same fit years later, nothing silly."""

from __future__ import annotations

import copy
import pickle
import re
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli
from implicam.calibration_file import describe
from implicam.calibrators import CALIBRATORS, CalibratorBase
from implicam.calibrators.explicit import ExplicitCalibration
from implicam.calibrators.explicit.settings import OF_PAPER_PRESETS, OF_PIPELINE
from implicam.calibrators.protocol import settings_type
from implicam.cli.settings import settings_table, settings_text
from implicam.errors import CalibrationFileError, FitError, UsageError
from implicam.files import toml_text
from implicam.rig_model.settings import RigModelSettings
from implicam.settings import BELOW_ONE, COUNT, MAX_COUNT, Settings, unit_of
from implicam.simulate import build_rig, random_positions, simulate
from test_explicit_cases import held, in_the_room

__all__ = ["cli"]

ROOT = Path(ic.__file__).parent
FORMAT_2 = Path(__file__).parent / "data" / "settings-format-2.toml"


@dataclass(frozen=True)
class Case:
    """A method, quick options of it, and settings that change its fit."""

    method: str
    quick: dict[str, Any]
    changed: dict[str, Any]

    @property
    def kind(self) -> type[Settings]:
        found = settings_type(CALIBRATORS[self.method].calibrator)
        assert found is not None
        return found

    def fit(self, data: ic.Dataset, **changed: Any) -> Any:
        return ic.calibrator(self.method, settings=self.kind(**{**self.quick, **changed})).fit(data)


CASES = {
    case.method: case
    for case in (
        Case("forward-gp", {}, {"camera_noise_log_sd": 1.0}),
        Case("explicit", {}, {"noise_prior_residuals": 50.0}),
        Case("inverse-gp", {}, {"axis_lengthscale_prior_median_sds": 2.0, "max_points_for_both_bases": 1}),
        Case("mlp", {"max_epochs": 60, "dropout_passes": 20}, {"learning_rate": 3e-3}),
    )
}
every_method = pytest.mark.parametrize("method", CASES)
every_setting = pytest.mark.parametrize(
    ("kind", "name"),
    [(case.kind, field.name) for case in CASES.values() for field in fields(case.kind)],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)


@cache
def known() -> ic.Dataset:
    rig = build_rig("stereo", seed=1)
    return simulate(rig, random_positions(rig, 20, np.random.default_rng(1)), seed=1)


@cache
def fitted(method: str) -> Any:
    return CASES[method].fit(known())


@cache
def changed_fit(method: str) -> Any:
    return CASES[method].fit(known(), **CASES[method].changed)


def other(kind: type[Settings], name: str) -> Any:
    """Another value of a setting, that makes sense."""
    default = {field.name: field.default for field in fields(kind)}[name]
    if isinstance(default, tuple):
        return tuple(1.1 * value if not name.endswith(BELOW_ONE) else 0.9 * value for value in default)
    return default + 1 if isinstance(default, int) else 0.9 * default


def all_other(kind: type[Settings]) -> Settings:
    return kind(**{field.name: other(kind, field.name) for field in fields(kind)})


def same(a: Any, b: Any) -> bool:
    """Whether two calibrations hold and measure the same, to the last bit."""
    states, measured = (a.state(), b.state()), [c.measure(known().observations) for c in (a, b)]
    return (
        states[0][0] == states[1][0]
        and states[0][1].keys() == states[1][1].keys()
        and all(np.array_equal(array, states[1][1][name], equal_nan=True) for name, array in states[0][1].items())
        and all(
            np.array_equal(getattr(measured[0], x), getattr(measured[1], x), equal_nan=True) for x in ("xyz", "cov")
        )
    )


def test_every_method_has_settings_and_is_in_the_contract() -> None:
    assert set(CASES) == {name for name in CALIBRATORS if settings_type(CALIBRATORS[name].calibrator) is not None}
    assert set(CASES) >= {"forward-gp", "explicit", "inverse-gp", "mlp"}


@every_setting
def test_each_setting_has_a_unit_and_a_text_and_is_used(kind: type[Settings], name: str) -> None:
    (told,) = (one for one in kind().described() if one.name == name)
    assert told.unit
    assert told.text[0].isupper() or told.text[:2] in ("p-", "..")
    assert re.search(r"[.)]$", told.text) or told.text.endswith("...")
    assert documented()[name] == sum(name in vars(owner).get("__annotations__", {}) for owner in every_owner())
    assert name in used() or name.endswith("_kind")


@cache
def source() -> str:
    return "\n".join(path.read_text() for path in ROOT.rglob("*.py"))


@cache
def documented() -> Counter[str]:
    """Fields with a text below them, in all of the source."""
    return Counter(re.findall(r'^    (\w+): .*\n    """', source(), re.M))


@cache
def used() -> set[str]:
    """Names after a dot."""
    return set(re.findall(r"\.(\w+)", source()))


def every_owner() -> set[type]:
    """The classes that state settings themselves."""
    return {owner for case in CASES.values() for owner in case.kind.__mro__ if issubclass(owner, Settings)}


def test_a_name_that_does_not_say_its_unit_is_found() -> None:
    assert unit_of("max_error_half_sides_without_lens", 1.0) == "half sides"
    assert unit_of("anything", 3) == COUNT
    with pytest.raises(KeyError):
        unit_of("max_error", 1.0)


@every_method
def test_defaults_are_those_of_files_of_format_2(method: str) -> None:
    """Files without settings, or without one that came later, were made with these. Who changes a default writes the
    old one into such files (calibration_file._UPGRADES), with a new format version, and then a new file here."""
    of_format_2 = tomllib.loads(FORMAT_2.read_text())[method]
    assert CASES[method].kind().as_table() == of_format_2


@every_method
def test_all_settings_come_back_from_a_file(method: str, tmp_path: Path) -> None:
    settings = all_other(CASES[method].kind)
    assert len(settings.changed()) == len(fields(settings))
    calibration = fitted(method)
    replace(calibration, calibrator=replace(calibration.calibrator, settings=settings)).save(tmp_path / "a.implicam")
    loaded = ic.load_calibration(tmp_path / "a.implicam")
    assert loaded.calibrator.settings == settings  # type: ignore[attr-defined]
    assert describe(tmp_path / "a.implicam")["options"]["settings"] == settings.as_table()


@every_method
def test_a_refit_of_a_loaded_file_is_the_same_fit(method: str, tmp_path: Path) -> None:
    calibration = changed_fit(method)
    calibration.save(tmp_path / "a.implicam")
    loaded = ic.load_calibration(tmp_path / "a.implicam")
    assert same(loaded, calibration)
    assert same(loaded.refit(known()), calibration)
    assert not same(loaded, fitted(method))


@every_method
def test_a_changed_setting_changes_more_than_the_file(method: str) -> None:
    usual, changed = (one.measure(known().observations) for one in (fitted(method), changed_fit(method)))
    assert np.nanmax(np.abs(changed.cov - usual.cov) / usual.cov) > 1e-6


@every_method
def test_settings_at_their_defaults_change_nothing(method: str) -> None:
    kind = CASES[method].kind
    stated = kind(**{field.name: field.default for field in fields(kind)})
    assert stated == kind()
    assert repr(stated) == f"{kind.__name__}()"
    assert ic.calibrator(method) == ic.calibrator(method, settings=stated)


@every_method
def test_settings_are_values(method: str) -> None:
    kind = CASES[method].kind
    settings, name = all_other(kind), fields(kind)[-1].name
    assert pickle.loads(pickle.dumps(settings)) == copy.deepcopy(settings) == replace(settings) == settings
    assert len({settings, replace(settings), kind()}) == 2
    assert kind.from_table(tomllib.loads(toml_text(settings.as_table()))) == settings
    only = kind(**{name: other(kind, name)})
    assert repr(only) == f"{kind.__name__}({name}={other(kind, name)!r})"


@every_method
def test_a_file_without_settings_or_with_some_has_the_defaults(method: str) -> None:
    calibration = fitted(method)
    table, arrays = calibration.state()
    del table["settings"]
    kind, restore = CASES[method].kind, type(calibration).from_state
    assert restore(calibration.data, table, arrays).calibrator.settings == kind()
    one = {fields(kind)[0].name: other(kind, fields(kind)[0].name)}
    assert restore(calibration.data, table | {"settings": one}, arrays).calibrator.settings == kind(**one)


def hostile(kind: type[Settings]) -> dict[str, Any]:
    """Name -> a value that makes no sense: of each type of setting some, one after the other."""
    wrong: dict[type, list[Any]] = {
        int: [0, -3, 2.5, True, "3", MAX_COUNT + 1, 10**400, [3], None],
        float: [0.0, -1.0, float("nan"), float("inf"), 10**400, "1.0", False, [1.0], {"a": 1.0}],
        tuple: [[], [0.0, 0.0], 1.0, ["a", "b"], [float("nan")], [[1.0]], "ab"],
    }
    turn = dict.fromkeys(wrong, 0)
    found = {}
    for field in fields(kind):
        of = type(field.default)
        found[field.name] = wrong[of][turn[of] % len(wrong[of])]
        turn[of] += 1
    return found


@every_method
def test_values_that_make_no_sense_are_refused_everywhere(method: str, tmp_path: Path) -> None:
    kind, calibration = CASES[method].kind, fitted(method)
    table, arrays = calibration.state()
    for name, value in hostile(kind).items():
        with pytest.raises(UsageError, match=rf"the setting {name} must be (above|a|\d|at least)") as refused:
            kind.from_table({name: value})
        assert "is the default" in refused.value.fix
        with pytest.raises(UsageError):
            type(calibration).from_state(calibration.data, table | {"settings": {name: value}}, arrays)
    for whole in ("settings", 3, [1], {"nothing_like_it": 3}):
        with pytest.raises(UsageError):
            type(calibration).from_state(calibration.data, table | {"settings": whole}, arrays)
    broken = replace(calibration)
    path = tmp_path / "a.implicam"
    object.__setattr__(broken, "state", lambda: (table | {"settings": {fields(kind)[0].name: -1}}, arrays))
    broken.save(path)
    with pytest.raises(CalibrationFileError, match="not a usable calibration"):
        ic.load_calibration(path)


@every_method
def test_what_is_no_setting_is_refused_with_the_nearest(method: str) -> None:
    kind = CASES[method].kind
    name = fields(kind)[-1].name
    for refused in (lambda: kind.from_table({name + "x": 3}), lambda: kind(**{name + "x": 3})):
        with pytest.raises(UsageError, match=rf"there is no setting '{name}x' \(did you mean '{name}'\?\)"):
            refused()
    with pytest.raises(UsageError, match=f"settings of {method} are of the type {kind.__name__}, and not"):
        ic.calibrator(method, settings=RigModelSettings() if method != "mlp" else ic.InverseGPSettings())
    with pytest.raises(UsageError, match=f"settings of {method}"):
        ic.calibrator(method, settings={"a": 1})


def test_a_method_without_settings_needs_none() -> None:
    @dataclass(frozen=True)
    class Plain(CalibratorBase):
        stiffness: float = 1.0

        method: ClassVar[str] = "plain"

    assert settings_type(Plain) is None
    assert Plain.from_table(Plain(2.0).as_table()) == Plain(2.0)
    with pytest.raises(KeyError):
        Plain.from_table({})


# explicit: what its settings do where boards are


@cache
def boards() -> ic.Dataset:
    return held(1, count=6)


def from_boards(**changed: Any) -> Any:
    return ic.Explicit(boards=boards(), settings=ic.ExplicitSettings(**changed)).fit(in_the_room(12, 1))


@cache
def usual_from_boards() -> Any:
    return from_boards()


@pytest.mark.slow
@pytest.mark.parametrize(
    "changed",
    [
        {"max_corner_error_sds": 2.0, "max_wrong_corner_share": 0.9},
        {"max_together_ratio": 0.5},
        {"any_pixels_odds_ratio": 1e-200},
    ],
    ids=lambda changed: " ".join(changed),
)
def test_settings_of_boards_change_the_fit(changed: dict[str, Any]) -> None:
    new = in_the_room(20, 5).observations
    one, another = (calibration.measure(new) for calibration in (usual_from_boards(), from_boards(**changed)))
    far = np.abs(one.xyz - another.xyz) / one.sd
    assert np.nanmax(far) > 1e-3 or not np.allclose(one.cov, another.cov, rtol=1e-3, equal_nan=True)


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"min_corners": 19}, "cameras can be calibrated together"),
        ({"max_board_start_error_half_sides": 1e-9}, "cameras can be calibrated together"),
        ({"max_camera_error_half_sides": 1e-9}, "cameras contradict each other"),
        ({"max_alignment_error_extents": 1e-9}, "boards and the known points contradict"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_settings_of_boards_refuse(changed: dict[str, Any], what: str) -> None:
    with pytest.raises(FitError, match=what):
        from_boards(**changed)


def test_settings_of_the_alarm_are_those_of_explicit() -> None:
    new = in_the_room(20, 5).observations
    wrong = replace(new, uv=new.uv + np.array([0.0, 3.0]) * np.array([1.0, -1.0])[:, None])
    usual = usual_from_boards()
    deaf = ic.ExplicitSettings(min_alarm_points=1000)
    assert usual.measure(wrong).alarm
    assert not replace(usual, calibrator=replace(usual.calibrator, settings=deaf)).measure(wrong).alarm


# the command line


Write = Callable[[str], Path]


@pytest.fixture
def settings_file(tmp_path: Path) -> Write:
    def write(text: str) -> Path:
        path = tmp_path / "settings.toml"
        path.write_text(text)
        return path

    return write


@every_method
def test_calibrate_takes_settings_and_info_gives_them_back(method: str, cli: Cli, settings_file: Write) -> None:
    case = CASES[method]
    given = {**case.quick, **case.changed}
    ic.write_dataset(known(), "rig")
    words = ["calibrate", "rig", "--method", method, "--force", "-o"]
    ran = cli(*words, "a.implicam", "--settings", settings_file(toml_text(given)))
    assert ran.code == 0, ran.err
    loaded = ic.load_calibration("a.implicam")
    assert loaded.calibrator.settings == case.kind(**given)  # type: ignore[attr-defined]
    assert same(loaded, changed_fit(method))
    brief = cli("info", "a.implicam").out
    total = len(fields(case.kind))
    assert f"the other {total - len(given)} settings are at their defaults" in brief
    assert all(f"{name} = " in brief for name in given)
    full = cli("info", "a.implicam", "--settings").out
    assert tomllib.loads(full) == case.kind(**given).as_table()  # it is a file for --settings, too
    assert full.count("the default is") == len(given)
    for one in case.kind().described():
        assert re.search(rf"^{one.name} = .*  # {re.escape(one.unit)}", full, re.M)
        assert one.text.split(" ", 3)[0] in full
    (machine,) = [
        one for one in cli("info", "a.implicam", "--settings", "--json").json["settings"] if one["name"] in given
    ][:1]
    assert set(machine) == {"name", "value", "default", "unit", "text", "in_force"}
    assert machine["value"] == given[machine["name"]]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("min_residual = 3", "there is no setting 'min_residual' (did you mean 'min_residuals'?)"),
        ("max_rounds = 3", "there is no setting 'max_rounds'"),
        ("min_residuals = 3.5", "the setting min_residuals must be a whole number, and is 3.5"),
        ('min_residuals = "3"', "the setting min_residuals must be a whole number"),
        ("min_residuals = true", "the setting min_residuals must be a whole number"),
        ("max_distance_ratio = 1979-05-27", "the setting max_distance_ratio must be a number"),
        ("max_distance_ratio = nan", "the setting max_distance_ratio must be above 0, and finite"),
        ("max_distance_ratio = -1", "the setting max_distance_ratio must be above 0"),
        ("[options.settings]\nmin_residuals = 3", "[options] is a table, and settings are not in tables"),
        ("min_residuals 3", "is no TOML file"),
        ("min_residuals = 3\nmin_residuals = 4", "is no TOML file"),
        (f"min_residuals = 1{'0' * 5000}", "is no TOML file"),
    ],
)
def test_settings_files_that_make_no_sense_are_refused(text: str, told: str, cli: Cli, settings_file: Write) -> None:
    ic.write_dataset(known(), "rig")
    ran = cli("calibrate", "rig", "--method", "inverse-gp", "-o", "a.implicam", "--settings", settings_file(text))
    assert ran.code != 0
    assert told in ran.err.replace("\n", " ")
    assert "fix:" in ran.err
    assert "Traceback" not in ran.err
    assert not Path("a.implicam").exists()


def test_settings_files_that_cannot_be_read_are_refused(cli: Cli, tmp_path: Path) -> None:
    ic.write_dataset(known(), "rig")
    (tmp_path / "latin.toml").write_bytes(b"min_residuals = 3 # \xff")
    for path, told in (("nowhere.toml", "cannot be read"), ("rig", "cannot be read"), ("latin.toml", "no TOML file")):
        ran = cli("calibrate", "rig", "--method", "inverse-gp", "-o", "a.implicam", "--settings", path)
        assert ran.code != 0
        assert told in ran.err
        assert "fix:" in ran.err


# explicit: what its presets have a use for


def test_what_the_paper_presets_read_is_what_is_in_force() -> None:
    folder = ROOT / "calibrators" / "explicit"
    pipeline, preset = (set(re.findall(r"settings\.(\w+)", (folder / name).read_text())) for name in
                        ("opencv_pipeline.py", "paper_preset.py"))  # fmt: skip
    names = {field.name for field in fields(ic.ExplicitSettings)}
    assert pipeline & names == set(OF_PIPELINE)
    assert preset & names <= set(OF_PAPER_PRESETS) <= names
    assert ic.Explicit().idle_settings == set(OF_PIPELINE)
    idle = ic.Explicit(preset="paper").idle_settings
    assert idle == names - set(OF_PAPER_PRESETS) == ic.Explicit(preset="paper-bundle").idle_settings


def test_settings_that_do_nothing_are_told() -> None:
    """Shown last, and in the notes where somebody set one."""
    settings = ic.ExplicitSettings(point_folds=4, wide_from_degrees=80.0)
    notes = {}
    for preset, idle, used in (
        ("paper", "point_folds", "wide_from_degrees"),
        ("joint", "wide_from_degrees", "point_folds"),
    ):
        calibrator = ic.Explicit(preset=preset, settings=settings)
        fit = ExplicitCalibration(calibrator, None, SimpleNamespace(notes=("first",)))  # type: ignore[arg-type]
        in_force, _, without_effect = settings_text(fit).partition("do nothing")
        assert f"{used} = " in in_force
        assert f"{idle} = " not in in_force
        assert f"{idle} = " in without_effect
        assert ic.ExplicitSettings.from_table(tomllib.loads(settings_text(fit))) == settings
        states = {one["name"]: one["in_force"] for one in settings_table(fit)["settings"]}
        assert (states[used], states[idle]) == (True, False)
        notes[preset] = fit.notes
    assert notes["paper"] == ["first", "The preset paper has no use for the settings point_folds."]
    assert notes["joint"] == ["first", "The preset joint has no use for the settings wide_from_degrees."]


@pytest.mark.parametrize("preset", ["smooth", "plain"])
def test_what_inverse_gp_calls_idle_changes_nothing(preset: str) -> None:
    """And what it does not call so may: each idle setting, doubled, leaves every number as it is."""
    calibrator = ic.InverseGP(preset=preset)
    doubled = {name: 2 * getattr(calibrator.settings, name) for name in calibrator.idle_settings}
    changed = ic.InverseGP(preset=preset, settings=ic.InverseGPSettings(**doubled))
    assert changed.idle_settings == calibrator.idle_settings
    fit, usual = changed.fit(known()), calibrator.fit(known())
    a, b = (calibration.measure(known().observations) for calibration in (fit, usual))
    np.testing.assert_array_equal(a.xyz, b.xyz)
    np.testing.assert_array_equal(a.cov, b.cov)
    (told,) = set(fit.notes) - set(usual.notes)
    assert told == f"The preset {preset} has no use for the settings {', '.join(sorted(doubled))}."
