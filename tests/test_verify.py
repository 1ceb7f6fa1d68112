"""Acceptance tests with calibrated lengths: the decision, statistics, the arrangement, the protocol, the command."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import implicam as ic
from command_line import Cli, cli, made  # noqa: F401  fixtures
from implicam import calibration_file
from implicam.active import Workspace
from implicam.dataset import Dataset
from implicam.derived import joint_distances
from implicam.errors import DatasetError, UsageError
from implicam.simulate import Rig, build_rig, random_positions, simulate, step_gauge
from implicam.verification import MaximumPermissibleError, Verification, decide, read_lengths
from implicam.verification.lengths import lengths_by_names, shared_covariance
from implicam.verification.printing import find_browser, print_page
from implicam.verification.protocol import Circumstances, page
from implicam.verification.statistics import (
    check_error_bars,
    constant_rather_than_scale,
    fit_scale,
    unlike_the_others,
)
from implicam.verification.volume import bounding_box, cover, name_lines


@cache
def rig_and_calibration() -> tuple[Rig, ic.Calibration]:
    rig = build_rig("stereo", seed=1, lens_error=0.5)
    return rig, ic.ForwardGP().fit(simulate(rig, random_positions(rig, 80, np.random.default_rng(1)), seed=1))


@cache
def gauge(seed: int = 5, scale: float = 1.0) -> tuple[Dataset, list[ic.CalibratedLength]]:
    rig, _ = rig_and_calibration()
    target, lengths = step_gauge(rig)
    views = replace(simulate(rig, target, seed=seed), known=None)
    return views, [ic.CalibratedLength(one.a, one.b, one.length * scale, sd=0.001, line=one.line) for one in lengths]


@cache
def measured(seed: int = 5) -> ic.Measurement:
    return rig_and_calibration()[1].measure(gauge(seed)[0].observations)


def verified(**more: object) -> Verification:
    """Of the gauge as it is; nothing is placed, which takes most of the time."""
    more = {"next_lengths": 0, **more}
    return ic.verify(rig_and_calibration()[1], measured(), gauge()[1], **more)  # type: ignore[arg-type]


# the limit


@pytest.mark.parametrize(
    ("text", "constant", "per_length"),
    [
        (0.05, 0.05, 0), ("0.05", 0.05, 0), ("L/20000", 0, 5e-5), ("0.05 + L/20000", 0.05, 5e-5),
        (".1+3L/1000", 0.1, 3e-3), ("2e-3 + 5e-5*L", 2e-3, 5e-5), ("1 + 3 × L / 1e4", 1, 3e-4),
    ],
)  # fmt: skip
def test_limits_are_read_as_specifications_write_them(text: str | float, constant: float, per_length: float) -> None:
    limit = MaximumPermissibleError.parse(text)
    assert (limit.constant, limit.per_length) == pytest.approx((constant, per_length))
    assert limit.at(100) == pytest.approx(constant + 100 * per_length)
    again = MaximumPermissibleError.parse(str(limit))
    assert again.at(100) == pytest.approx(limit.at(100), rel=1e-5)


@pytest.mark.parametrize(
    "text", ["", "0.05 +", "A + L/K", "-0.05", "0,05", "0.05 + L/0", "0", "nan", "L/20000 + 0.05 mm"]
)
def test_what_is_no_limit_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        MaximumPermissibleError.parse(text)


def test_the_decision_rule_counts_the_uncertainty_against_who_proves() -> None:
    assert [decide(error, 1.0, 0.25) for error in (0.75, -0.75, 0.76, -1.25, 1.26, -2)] == [
        "conforms", "conforms", "undecided", "undecided", "does not conform", "does not conform",
    ]  # fmt: skip


# lengths


def test_temperature_and_certificate_make_the_uncertainty_of_the_test() -> None:
    one = ic.CalibratedLength(
        "a", "b", 1000.0, sd=0.003, temperature=22.0, expansion=11.5e-6, sd_temperature=0.2, sd_expansion=1e-6,
        sd_setup=0.004,
    )  # fmt: skip
    assert one.corrected == pytest.approx(1000.023)
    assert one.sd_of_temperature == pytest.approx(np.hypot(0.0023, 0.002))
    assert one.sd_test == pytest.approx(np.sqrt(0.003**2 + 0.0023**2 + 0.002**2 + 0.004**2))
    other = replace(one, b="c", artefact="another")
    cov = shared_covariance([one, replace(one, b="c"), other])
    assert cov[0, 1] == pytest.approx(one.sd_shared**2)
    assert cov[0, 2] == 0
    assert np.diagonal(cov) == pytest.approx(one.sd_test**2)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"b": "a"}, "is one"), ({"length": -1.0}, "is none"), ({"sd": -1.0}, "sd is"),
        ({"temperature": 25.0}, "not as long"), ({"expansion": 1e-5}, "no temperature"),
        ({"expansion": 11.5, "temperature": 20.0}, "not possible"),
    ],
)  # fmt: skip
def test_impossible_lengths_are_refused(given: dict[str, object], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        ic.CalibratedLength(**{"a": "a", "b": "b", "length": 1.0, **given})  # type: ignore[arg-type]


def test_a_table_of_lengths_is_read(tmp_path: Path) -> None:
    path = tmp_path / "lengths.csv"
    path.write_text(
        "line,a,b,length,U,k,artefact,temperature,expansion\nL1,p,q,500,0.004,2,bar,21,1.2e-5\nL1,p,r,700,,,bar,,\n"
    )
    first, second = read_lengths(path)
    assert (first.sd, first.line, first.artefact, first.temperature) == (0.002, "L1", "bar", 21)
    assert (second.sd, second.temperature, second.title) == (None, None, "p - r")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,b\np,q\n", "column 'length' is missing"),
        ("a,b,length,temprature\np,q,1,2\n", "did you mean 'temperature'"),
        ("a,b,length,sd,U\np,q,1,2,3\n", "both sd and U"), ("a,b,length\np,q,x\n", "line 2"),
        ("a,b,length\np,p,5\n", "line 2: a length is between two points"), ("a,b,length,k\np,q,5,2\n", "k, but no U"),
        ("a,b,length\n", "no lengths"), ("a,b,length,U,k\np,q,5,1,0.5\n", "not usual"),
        ("a,b,length\np,q,\n", "line 2"),
    ],
)  # fmt: skip
def test_mistakes_in_a_table_of_lengths_are_named(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "lengths.csv"
    path.write_text(text)
    with pytest.raises(DatasetError) as error:
        read_lengths(path)
    assert says in str(error.value)


@pytest.mark.parametrize("written", ["line;a;b;length;U", "sep=;\nline;a;b;length;U", "line\ta\tb\tlength\tU"])
def test_a_table_of_lengths_as_german_excel_writes_it(written: str, tmp_path: Path) -> None:
    mark = "\t" if "\t" in written else ";"
    path = tmp_path / "lengths.csv"
    path.write_text(f"{written}\n" + mark.join(["L1", "p1", "p2", "500,0125", "0,002"]) + "\n")
    (one,) = read_lengths(path)
    assert (one.a, one.b, one.length, one.sd) == ("p1", "p2", 500.0125, 0.001)


def test_ends_are_found_by_their_names() -> None:
    found = lengths_by_names(["bar01_a", "bar02-A", "bar01_b", "bar02-B", "bar03_a", "x"], 500.0, sd=0.1)
    assert [(one.a, one.b, one.line) for one in found] == [
        ("bar01_a", "bar01_b", "bar01"),
        ("bar02-A", "bar02-B", "bar02"),
    ]
    with pytest.raises(DatasetError, match="which points"):
        lengths_by_names(["p1", "p2"], 500.0)


# statistics


def test_joint_distances_are_the_distances_with_what_they_share() -> None:
    seen = measured()
    pairs = [("L1-0", "L1-1"), ("L1-0", "L1-5"), ("L2-0", "L2-5")]
    both, single = joint_distances(seen, pairs), ic.distances(seen, pairs)
    assert both.values == pytest.approx([one.value for one in single])
    assert np.sqrt(np.diagonal(both.cov)) == pytest.approx([one.sd for one in single], rel=1e-9)
    step = 1e-4  # a length by the shared standard normal numbers of its points: the same slope as by differences
    points = ic.derived.joint(seen, ["L1-0", "L1-1", "L1-5"])
    moved = points.xyz[None] + step * np.moveaxis(points.shared, 2, 0)
    lengths = np.stack(
        [np.linalg.norm(moved[:, 1] - moved[:, 0], axis=1), np.linalg.norm(moved[:, 2] - moved[:, 0], axis=1)]
    )
    slope = (lengths - both.values[:2, None]) / step
    u = (points.xyz[1:] - points.xyz[0]) / both.values[:2, None]
    assert both.cov[0, 1] == pytest.approx(slope[0] @ slope[1] + u[0] @ points.own[0] @ u[1], rel=1e-4)


def test_the_scale_test_finds_what_it_says_and_its_power_is_true() -> None:
    rng, length = np.random.default_rng(0), np.linspace(50, 350, 35)
    root = rng.normal(size=(35, 35)) * 0.02 + 0.1 * np.eye(35)
    cov, scale = root @ root.T, 3e-4
    tests = [fit_scale(scale * length + root @ rng.normal(size=35), length, cov) for _ in range(1000)]
    power = tests[0].power(scale)
    assert np.mean([one.found for one in tests]) == pytest.approx(power, abs=4 * np.sqrt(power * (1 - power) / 1000))
    inside = np.mean([one.interval[0] < scale < one.interval[1] for one in tests])
    assert inside == pytest.approx(0.95, abs=0.03)
    assert tests[0].power(tests[0].detectable) == pytest.approx(0.95, abs=1e-3)
    assert tests[0].power(0.0) == pytest.approx(0.05)
    bars = [check_error_bars(root @ rng.normal(size=35), cov) for _ in range(1000)]
    assert np.mean([one.verdict == "right" for one in bars]) == pytest.approx(0.95, abs=0.03)
    assert check_error_bars(2 * root @ rng.normal(size=35), cov).verdict == "too small"
    assert check_error_bars(0.4 * root @ rng.normal(size=35), cov).verdict == "too large"
    assert check_error_bars(np.ones(2), np.eye(2)).verdict == "cannot tell"


def test_the_uncertainty_of_the_scale_grows_where_lengths_scatter() -> None:
    rng, length = np.random.default_rng(0), np.linspace(50, 350, 35)
    test = fit_scale(3 * rng.normal(size=35), length, np.eye(35))
    assert test.widened == pytest.approx(3, rel=0.3)
    assert fit_scale(rng.normal(size=35), length, np.eye(35)).widened == 1


def test_a_constant_error_is_told_from_an_error_of_scale() -> None:
    rng, found = np.random.default_rng(5), {"constant": 0, "scale": 0, "neither": 0}
    length = np.tile(np.linspace(50.0, 500.0, 5), 7)
    shared = 0.01 * np.ones((35, 1)) + 2e-5 * length[:, None]
    cov = 0.02**2 * np.eye(35) + shared @ shared.T
    for _ in range(200):
        noise = rng.multivariate_normal(np.zeros(35), cov)
        found["constant"] += constant_rather_than_scale(noise + 0.1, length, cov) is not None
        found["scale"] += constant_rather_than_scale(noise + 5e-4 * length, length, cov) is not None
        found["neither"] += constant_rather_than_scale(noise, length, cov) is not None
    assert found["constant"] > 195
    assert found["scale"] == 0
    assert found["neither"] <= 4  # a likelihood ratio of 100 comes about by chance once in 100 times at most


def test_one_wrong_length_is_named_and_a_scale_error_is_none() -> None:
    rng, length = np.random.default_rng(0), np.linspace(50, 350, 35)
    error = 1e-3 * length + 0.01 * rng.normal(size=35)
    cov = 1e-4 * np.eye(35)
    assert unlike_the_others(error, length, cov) == []
    error[7] += 0.2
    assert unlike_the_others(error, length, cov) == [7]
    both = cov + 0.02 * np.outer(length, length) / 350**2  # with a large error that all share
    error[7] += 100
    assert unlike_the_others(error, length, both) == [7]
    error[::2] += 0.2  # not single lengths
    assert unlike_the_others(error, length, cov) == []


# verification


def test_a_good_rig_conforms_and_a_gauge_with_another_scale_is_caught() -> None:
    found = verified(mpe="2 + L/200")
    assert found.decision == "conforms"
    assert found.trusted
    assert found.bars is not None
    assert found.bars.verdict == "right"
    assert found.scale is not None
    assert not found.scale.found
    assert found.worst in found.lengths
    off = ic.verify(rig_and_calibration()[1], measured(), gauge(scale=1 / 1.01)[1], mpe="0.5 + L/2000", next_lengths=0)
    assert off.decision == "does not conform"
    assert off.scale is not None
    assert off.scale.found
    assert off.scale.interval[0] < 0.01 < off.scale.interval[1]
    assert "Non-conformity" in off.sentences()[0]


def test_without_a_limit_the_smallest_that_is_proven_is_told() -> None:
    found = verified()
    assert found.decision == "no limit"
    assert verified(mpe=found.demonstrated * 1.001).decision == "conforms"
    assert verified(mpe=found.demonstrated * 0.999).decision != "conforms"
    assert "would be proven" in found.sentences()[0]


def test_the_uncertainty_of_the_test_leaves_undecided_what_is_near_the_limit() -> None:
    worst = abs(verified().worst.error)
    assert verified(mpe=worst).decision == "undecided"
    assert verified(mpe=worst - 0.0019).decision == "undecided"
    assert verified(mpe=worst - 0.0021).decision == "does not conform"


def test_a_length_that_was_not_measured_proves_nothing() -> None:
    views, lengths = gauge()
    blind = views.observations.uv.copy()
    blind[list(views.points).index("L3-5")] = np.nan
    views = replace(views, observations=replace(views.observations, uv=blind))
    found = ic.verify(rig_and_calibration()[1], views, lengths, mpe=10.0)
    assert found.decision == "undecided"
    missing = [one for one in found.lengths if not one.is_measured]
    assert [one.length.b for one in missing] == ["L3-5"]
    assert "L3-5 was not measured" in missing[0].note
    assert "1 could not be measured" in " ".join(found.notes)
    assert page(found, Circumstances()).count("not measured") >= 2


def test_lengths_in_another_unit_are_refused_with_the_unit() -> None:
    calibration, views, lengths = rig_and_calibration()[1], measured(), gauge()[1]
    in_metres = [replace(one, length=one.length / 1000) for one in lengths]
    with pytest.raises(DatasetError, match="differs by 1000"):
        ic.verify(calibration, views, in_metres)
    result = ic.verify(calibration, views, in_metres, length_unit="m", mpe=0.01, next_lengths=0)
    assert result.decision == "conforms"
    assert result.worst.error == pytest.approx(verified(mpe=10).worst.error / 1000)
    assert result.volume is not None
    assert verified().volume is not None
    assert result.volume.covered == pytest.approx(verified().volume.covered)  # type: ignore[union-attr]
    with pytest.raises(DatasetError, match="times as long"):
        ic.verify(calibration, views, [replace(one, length=one.length / 1.5) for one in lengths])


def test_the_same_points_twice_and_unknown_points_are_refused() -> None:
    calibration, views, lengths = rig_and_calibration()[1], measured(), gauge()[1]
    with pytest.raises(UsageError, match="there 2 times"):
        ic.verify(calibration, views, [lengths[0], replace(lengths[0], a=lengths[0].b, b=lengths[0].a)])
    with pytest.raises(UsageError, match="did you mean 'L1-0'"):
        ic.verify(calibration, views, [replace(lengths[0], a="L1_0")])


def test_a_method_that_does_not_say_what_errors_share_still_decides() -> None:
    alone = replace(measured(), shared=None)
    found = ic.verify(rig_and_calibration()[1], alone, gauge()[1], mpe="2 + L/200", next_lengths=0)
    assert found.decision == "conforms"
    assert (found.bars, found.scale) == (None, None)
    assert "does not say" in " ".join(found.notes)


def test_a_mistake_in_one_length_counts_but_spoils_neither_error_bars_nor_scale() -> None:
    lengths = list(gauge()[1])
    lengths[8] = replace(lengths[8], length=lengths[8].length + 5)
    found = ic.verify(rig_and_calibration()[1], measured(), lengths, mpe="2 + L/200", next_lengths=0)
    assert found.decision == "does not conform"
    assert found.bars is not None
    assert (found.bars.verdict, found.bars.lengths) == ("right", 34)
    assert found.scale is not None
    assert (found.scale.widened, found.scale.found) == (1, False)
    assert any(note.startswith(f"{lengths[8].title} is unlike the others") for note in found.notes)


# the arrangement


def test_the_seven_lines_fulfil_what_the_standards_ask_and_one_line_does_not() -> None:
    rig, _ = rig_and_calibration()
    volume = Workspace.from_box(rig.volume)
    ends = np.array([[one.a, one.b] for one in gauge()[1]])
    xyz = dict(zip(step_gauge(rig)[0].points.tolist(), step_gauge(rig)[0].xyz, strict=True))
    places = np.array([[xyz[a], xyz[b]] for a, b in ends])
    lines = [one.line for one in gauge()[1]]
    found = cover(volume, places, lines, "mm", sizes=[100.0, 200.0], count=2)
    assert [check.fulfilled for check in found.checks] == [True, True, False, True, True, True]
    assert found.checks[2].found == "on 5 of 7"  # the gauge is a twentieth shorter than the two shortest lines
    assert found.covered > 0.8
    assert [one.covered for one in found.next] == sorted(one.covered for one in found.next)
    assert all(volume.inside(one.ends).all() for one in found.next)
    alone = cover(volume, places[:5], [""] * 5, "mm", sizes=[100.0], count=1)
    assert alone.lines == ("line 1",) * 5
    assert alone.covered < 0.5 * found.covered
    assert alone.next[0].covered >= alone.covered


def test_lines_are_found_where_they_have_no_name() -> None:
    line = np.array(
        [[[0, 0, 0], [10, 0, 0]], [[40, 0, 0], [20, 0, 0.1]], [[0, 20, 0], [10, 20, 0]], [[0, 0, 0], [0, 9, 0]]]
    )
    assert name_lines(line.astype(float), ["", "", "", "mine"], 100.0) == ("line 1", "line 1", "line 2", "mine")


def test_the_box_around_a_turned_volume_is_turned_with_it() -> None:
    rig = build_rig("stereo", seed=3, frame="random")
    corners = bounding_box(Workspace.from_box(rig.volume))
    sides = np.linalg.norm(corners[[1, 2, 4]] - corners[0], axis=1)
    assert sorted(sides) == pytest.approx(sorted(rig.volume.size))


# what is written


class _Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in ("meta", "link", "br", "line", "circle", "path", "polyline"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("meta", "link", "br", "line", "circle", "path", "polyline"):
            assert self.open.pop() == tag


def test_the_protocol_is_one_page_without_scripts_and_names_stay_text() -> None:
    found = verified(mpe="0.5 + L/1000")
    about = Circumstances(by="<b>me</b>", instrument="rig & co", checksum="0" * 64, purpose="reverification")
    text = page(found, about)
    tags = _Tags()
    tags.feed(text)
    assert tags.open == []
    assert "<script" not in text
    assert "http" not in text.replace("http-equiv", "")
    assert "&lt;b&gt;me&lt;/b&gt;" in text
    assert "Reverification test of rig &amp; co" in text
    assert text.count('class="bar') == 35
    assert "L7-0 - L7-5" in text
    assert page(found, about) == text
    assert "No limit was stated" in page(verified(), Circumstances())


def test_the_result_shows_itself(tmp_path: Path) -> None:
    found = verified(mpe=5.0)
    assert repr(found).startswith("conforms: 35 of 35 lengths measured")
    assert found._repr_html_().count("<tr>") == 13
    found.write_csv(tmp_path / "verify.csv")
    rows = list(csv.DictReader((tmp_path / "verify.csv").read_text().splitlines()))
    assert len(rows) == 35
    assert float(rows[3]["error"]) == found.lengths[3].error
    assert float(rows[3]["measured"]) - float(rows[3]["calibrated"]) == pytest.approx(found.lengths[3].error)
    json.dumps(found.as_table())
    pytest.importorskip("plotly")
    assert len(found.plot().data) == 3


def test_a_browser_prints_the_protocol(tmp_path: Path) -> None:
    browser = find_browser()
    if browser is None:
        pytest.skip("no Chromium or Chrome")
    (tmp_path / "page.html").write_text("<!doctype html><title>x</title><p>printed")
    print_page(tmp_path / "page.html", tmp_path / "page.pdf", browser)
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(ic.ImplicamError, match="did not print"):
        print_page(tmp_path / "page.html", tmp_path / "other.pdf", "/bin/false")
    assert not (tmp_path / "other.pdf").exists()


@pytest.mark.slow
def test_the_command_writes_protocol_and_table_and_ends_with_the_decision(made: Path, cli: Cli) -> None:
    file, lengths = made / "rig.implicam", made / "rig" / "lengths"
    ran = cli("verify", file, lengths, "--mpe", "2 + L/100", "--by", "me", "--next", "1")
    assert ran.code == 0
    assert ran.out.startswith("Conformity with MPE = 2 + L/100 mm is proven")
    assert calibration_file.checksum(file) in Path("verify.html").read_text()
    assert len(Path("verify.csv").read_text().splitlines()) == 36
    ran = cli("verify", file, lengths, "--mpe", "0.0001", "-o", "bad.html", "--purpose", "reverification")
    assert ran.code == 1
    assert "Non-conformity" in ran.err
    assert Path("bad.csv").is_file()
    assert cli("verify", file, made / "rig" / "check").code == 1  # it has no lengths.csv
    assert "lengths.csv does not exist" in cli("verify", file, made / "rig" / "check").err
    assert cli("verify", file, lengths, "--purpose", "fun").code == 2
    assert cli("verify", file, lengths, "-o", "page.pdf").code == 2
    assert cli("verify", file, lengths, "-o", lengths / "lengths.html").code == 2  # the table beside it is read
    assert cli("verify", file, lengths, "--length-sd", "1").code == 2
    told = cli("verify", file, lengths, "--length", "5").err
    assert "bar01_a and bar01_b" in told
    told = cli("verify", file, lengths, "--temperature", "25").err
    assert "expansion" in told
    warm = cli("verify", file, lengths, "--temperature", "25", "--expansion", "11.5e-6", "--json").json
    plain = cli("verify", file, lengths, "--json").json
    ratio = warm["lengths"][0]["calibrated"] / plain["lengths"][0]["calibrated"]
    assert ratio == pytest.approx(1 + 5 * 11.5e-6, rel=1e-9)


@pytest.mark.slow
def test_lengths_are_in_the_unit_that_is_said_whatever_the_data_are_in(made: Path, cli: Cli) -> None:
    lengths = made / "rig" / "lengths"
    assert cli("import", made / "cameras.toml", "-o", "in-m.implicam", "--unit", "m").code == 0
    ran = cli("verify", "in-m.implicam", lengths)
    assert ran.code == 2
    assert "say it: --unit mm or --unit m" in ran.err
    in_mm = cli("verify", "in-m.implicam", lengths, "--unit", "mm", "--json").json
    with (lengths / "lengths.csv").open() as file:
        rows = [(row["a"], row["b"], float(row["length"]) / 1000) for row in csv.DictReader(file)]
    Path("len_m.csv").write_text("a;b;length\n" + "".join(f"{a};{b};{x!r}\n" for a, b, x in rows))
    in_m = cli("verify", "in-m.implicam", lengths, "--lengths", "len_m.csv", "--unit", "m", "--json").json
    errors = [[1000 * one["error"] for one in in_m["lengths"]], [one["error"] for one in in_mm["lengths"]]]
    np.testing.assert_allclose(*errors, atol=1e-6)
    assert "import the cameras with --unit mm" in cli("evaluate", "in-m.implicam", made / "rig" / "check").err
    assert cli("import", made / "cameras.toml", "-o", "in-mm.implicam", "--unit", "mm").code == 0
    assert cli("evaluate", "in-mm.implicam", made / "rig" / "check").code == 0
