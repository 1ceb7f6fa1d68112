"""The paper's numbers as its LaTeX source has them, and figures that show what the data say."""

import json
import re
from dataclasses import FrozenInstanceError
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam.errors import MissingExtraError, UsageError
from implicam.experiments import published
from implicam.figures import interactive3d, panels3d, paper
from implicam.figures.panels3d import BOARD_SCALES, Scales
from implicam.formatting import number

pytest.importorskip("matplotlib")
pytest.importorskip("plotly")

SOURCE = Path(__file__).parents[2] / "shared" / "paper" / "implicit-multi-camera-calibration.tex"
SETS = ("2R", "2R2W", "2R4W")
SIZES = (17, 35, 52, 70, 87, 105, 122, 140, 157)
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&"


# ------------------------------------------------------------------------------------------------ what was published


def source() -> str:
    if not SOURCE.is_file():
        pytest.skip("the paper is not beside this checkout")
    return SOURCE.read_text(encoding="utf-8")


def source_table() -> list[tuple[str, int, list[float]]]:
    """Rows of the only table with numbers, read from LaTeX."""
    number = r"(?:\\textbf\{)?(\d+\.\d+)\}?\s*"
    row = re.compile(r"(2R\w*), (\d) cb\s*&\s*" + r"&\s*".join([number] * 6) + r"\\\\")
    return [(m[1], int(m[2]), [float(m[i]) for i in range(3, 9)]) for m in row.finditer(source())]


def flat(row: published.TableRow) -> list[float]:
    return [n for spread in (row.gp_rmse, row.gp_sd, row.network_rmse) for n in (spread.mean, spread.sd)]


def test_the_table_is_the_papers() -> None:
    expected = source_table()
    assert len(expected) == 12
    assert [(row.set, row.boards, flat(row)) for row in published.load("board").table] == expected


def test_the_table_adds_up() -> None:
    # Sums of the columns, computed from the LaTeX source; here so that a table without the paper is checked too.
    table = published.load("board").table
    assert [row.known for row in table] == [8 * 11 * row.boards for row in table]
    np.testing.assert_allclose(
        np.sum([flat(row) for row in table], axis=0), [100.74, 45.64, 131.28, 5.67, 186.48, 105.77], atol=1e-9
    )


def test_every_number_is_in_the_paper() -> None:
    text = source()
    for name in published.EXPERIMENTS:
        for stated in published.load(name).numbers.values():
            values = stated.value if isinstance(stated.value, tuple) else (stated.value,)
            for value in values:
                written = "zero" if value == 0 else f"{value:g}"
                assert re.search(rf"(?<![\d.]){re.escape(written)}(?![\d]|\.\d)", text), (name, stated)


def test_places_are_where_latex_puts_them() -> None:
    text = source()
    sections, figures = numbered_sections(text), numbered_figures(text)
    assert figures["fig:RMSEs"] == 5
    named = {
        "Figure 1": "fig:6Cams", "Figure 4": "fig:ICP", "Figure 5": "fig:RMSEs", "Figure 6": "fig:UQ",
        "Figure 7": "fig:UQExample", "Figure 8": "fig:AL", "Figure 11": "fig:MCBOverviewWide",
    }  # fmt: skip
    for words, label in named.items():
        assert words == f"Figure {figures[label]}"
    for name in published.EXPERIMENTS:
        content = published.load(name)
        places = [content.place, *(n.place for n in content.numbers.values())]
        places += [f.place for f in content.findings.values()]
        for place in places:
            found = re.findall(r"Figure \d+", place)
            assert set(found) <= set(named), place
            assert set(re.findall(r"\d(?:\.\d)?", re.sub(r"(Figure|Table) \d+", "", place))) <= sections, place


def numbered_sections(text: str) -> set[str]:
    found, section, sub = set(), 0, 0
    for kind in re.findall(r"^\\(section|subsection)\{", text, flags=re.M):
        section, sub = (section + 1, 0) if kind == "section" else (section, sub + 1)
        found.add(f"{section}.{sub}" if sub else str(section))
    return found


def numbered_figures(text: str) -> dict[str, int]:
    bodies = re.findall(r"\\begin\{figure\*?\}(.*?)\\end\{figure\*?\}", text, flags=re.S)
    return {re.findall(r"\\label\{(fig:[^}]*)\}", body)[-1]: i + 1 for i, body in enumerate(bodies)}


def test_findings_about_the_table_hold_in_it_as_remarked() -> None:
    rows = {(row.set, row.boards): row for row in published.load("board").table}
    boards = (2, 3, 5, 9)
    assert all(row.gp_rmse.mean < row.network_rmse.mean for row in rows.values())
    for name in SETS:
        rmse = np.array([rows[name, b].gp_rmse.mean for b in boards])
        sd = np.array([rows[name, b].gp_sd.mean for b in boards])
        assert (np.diff(rmse) < 0).all()
        assert (np.diff(sd) < 0).all()
        assert np.argmin(-np.diff(rmse)) == 2
    by_cameras = {b: [rows[name, b].gp_rmse.mean for name in SETS] for b in boards}
    assert [b for b in boards if sorted(by_cameras[b], reverse=True) == by_cameras[b]] == [2, 5, 9]
    findings = published.load("board").findings
    assert ", ".join(f"{v:.2f}" for v in by_cameras[3]) in findings["more_cameras_lower_rmse"].remark
    stated = {b: [rows[name, b].gp_sd.mean for name in SETS] for b in boards}
    assert [b for b in boards if sorted(stated[b]) == stated[b]] == [2, 5, 9]
    assert ", ".join(f"{v:.2f}" for v in stated[9]) in published.load("ball").findings["more_cameras_lower_sd"].remark
    assert any(np.diff([rows[name, b].network_rmse.mean for b in boards]).max() > 0 for name in SETS)


def test_numbers_that_follow_from_each_other() -> None:
    ball, board = published.load("ball").numbers, published.load("board").numbers
    assert np.prod(ball["grid"].value) == ball["positions"].value == 175
    assert 3 * len(ball["train_percent"].value) * ball["runs_per_cell"].value == ball["runs"].value
    assert int(0.9 * 175) == ball["most_points"].value
    assert int(0.1 * 175) == ball["fewest_points"].value
    corners = np.prod(board["corners"].value)
    assert [corners * b for b in (2, 9)] == [board["fewest_points"].value, board["most_points"].value]
    assert published.load("active").numbers["positions"].value == 175


def test_findings_name_numbers_and_sets_that_exist() -> None:
    for name in published.EXPERIMENTS:
        content = published.load(name)
        assert content.experiment == name
        for finding in content.findings.values():
            assert set(finding.numbers) <= set(content.numbers)
            assert set(finding.sets) <= set(SETS)
            assert finding.statement.endswith(".")


def test_what_was_published_cannot_be_changed() -> None:
    board = published.load("board")
    with pytest.raises(FrozenInstanceError):
        board.table[0].boards = 3  # type: ignore[misc]
    with pytest.raises(TypeError):
        board.numbers["square"] = board.numbers["step"]  # type: ignore[index]


@pytest.mark.parametrize("name", ["bord", "", "../board"])
def test_an_unknown_experiment_is_told(name: str) -> None:
    with pytest.raises(UsageError, match="Choose one of setup, ball, active, board"):
        published.load(name)


# ------------------------------------------------------------------------------------------------------------ curves


def ball_rows(runs: int = 7, methods: tuple[str, ...] = ("inverse-gp", "mlp"), seed: int = 0) -> list[dict[str, Any]]:
    rng = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    for name in SETS:
        for method in methods:
            for known in SIZES:
                for run in range(runs):
                    error = 300 / known * np.exp(0.3 * rng.normal())
                    sd = None if method == "mlp" else error / 2
                    rows.append(
                        {"set": name, "method": method, "known": known, "run": run, "rmse": error, "mean_sd": sd}
                    )
    return rows


def explicit_rows(errors: dict[str, tuple[float, ...]], name: str = "2R") -> list[dict[str, Any]]:
    return [
        {"set": name, "method": "explicit", "budget": budget, "rmse": error, "mean_sd": error / 3}
        for budget, several in errors.items()
        for error in several
    ]


def lines_of(axes: Any) -> dict[str, Any]:
    return {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}


def median(rows: list[dict[str, Any]], key: str, **wanted: Any) -> float:
    return float(np.median([row[key] for row in rows if all(row[k] == v for k, v in wanted.items())]))


def test_rmse_curves_show_the_medians_and_all_runs() -> None:
    rows = ball_rows()
    figure = paper.rmse_curves(rows[::-1], total=175)
    assert [axes.get_title(loc="left").partition(":")[0] for axes in figure.axes] == list(SETS)
    for axes, name in zip(figure.axes, SETS, strict=True):
        assert axes.get_yscale() == "log"
        assert set(lines_of(axes)) == {"inverse-gp", "mlp"}
        for method, line in lines_of(axes).items():
            expected = [median(rows, "rmse", set=name, method=method, known=known) for known in SIZES]
            np.testing.assert_allclose(line.get_ydata(), expected)
            assert np.abs(line.get_xdata() - SIZES).max() < 17.0 / 2  # bars stay nearer to their own tick
        whole = axes.collections[0].get_segments()
        mine = [row["rmse"] for row in rows if (row["set"], row["method"], row["known"]) == (name, "inverse-gp", 17)]
        assert tuple(whole[0][:, 1]) == (min(mine), max(mine))
    ticks = [tick.get_text() for tick in figure.axes[-1].get_xticklabels()]
    assert ticks[0] == "17\n10%"
    assert ticks[-1] == "157\n90%"
    assert figure.axes[-1].get_xlabel() == "training points, and their share of 175"


def test_explicit_lines_are_the_medians_in_the_papers_colours() -> None:
    rows = explicit_rows({"10+4": (9.0, 20.0, 10.0), "50+10": (2.0,), "25+6": (2.1,)}) + ball_rows(2)
    figure = paper.rmse_curves(rows)
    lines = lines_of(figure.axes[0])
    heights = {label: line.get_ydata()[0] for label, line in lines.items() if label.startswith("explicit")}
    assert heights == {
        "explicit, 50 + 10 pictures": 2.0, "explicit, 25 + 6 pictures": 2.1, "explicit, 10 + 4 pictures": 10.0
    }  # fmt: skip
    drawn = [line for label, line in lines.items() if label.startswith("explicit")]
    assert [line.get_color() for line in drawn] == ["#009E73", "#E69F00", "#D55E00"]
    assert len({str(line._unscaled_dash_pattern) for line in drawn}) == 3
    texts = {text.get_text(): text for text in figure.axes[0].texts}
    places = [texts[budget].get_position()[1] for budget in ("50 + 10", "25 + 6", "10 + 4")]
    assert np.diff(places).min() >= 0.085 - 1e-9  # in the order of the lines, and apart
    assert not any(label.startswith("explicit") for label in lines_of(figure.axes[1]))
    (legend,) = figure.legends
    assert len(legend.get_texts()) == 5


def test_the_papers_pipeline_is_a_line_at_the_subset_with_the_median_reprojection_error() -> None:
    rows = ball_rows(2)
    for method, factor in (("explicit", 1.0), ("explicit:paper", 2.0), ("explicit:paper-bundle", 3.0)):
        for budget in ("50+10", "10+4"):
            for error, reprojection in ((1.0, 0.3), (5.0, 0.2), (7.0, 0.4)):
                row = {"set": "2R", "method": method, "budget": budget, "mean_sd": 1.0, "reprojection": reprojection}
                rows.append({**row, "rmse": factor * error})
    lines = lines_of(paper.rmse_curves(rows).axes[0])
    heights = {label: line.get_ydata()[0] for label, line in lines.items() if label.startswith("explicit")}
    assert heights == {
        "explicit:paper, 50 + 10 pictures": 2.0, "explicit:paper, 10 + 4 pictures": 2.0,
        "explicit:paper-bundle, 50 + 10 pictures": 3.0, "explicit:paper-bundle, 10 + 4 pictures": 3.0,
        "explicit, 50 + 10 pictures": 1.0,
    }  # fmt: skip


def test_labels_beside_far_lines_stand_at_their_lines() -> None:
    figure = paper.rmse_curves(ball_rows(2) + explicit_rows({"50+10": (2.0,), "10+4": (20.0,)}))
    axes = figure.axes[0]
    low, high = np.log(axes.get_ylim())
    for text, error in zip(axes.texts, (2.0, 20.0), strict=True):
        assert text.get_position()[1] == pytest.approx((np.log(error) - low) / (high - low))


def test_all_methods_differ_without_colour() -> None:
    names = ("inverse-gp", "inverse-gp:paper", "mlp", "forward-gp", "another", "one more")
    lines = lines_of(paper.rmse_curves(ball_rows(2, names)).axes[0])
    assert set(lines) == set(names)
    assert len({line.get_marker() for line in lines.values()}) == len(names)
    assert len({line.get_linestyle() for label, line in lines.items() if label in names[:4]}) == 4
    alone = lines_of(paper.rmse_curves(ball_rows(2, ("mlp",))).axes[0])["mlp"]
    assert alone.get_color() == lines["mlp"].get_color()  # the same in every figure


def test_a_missing_number_breaks_the_line_and_a_missing_method_leaves_none(tmp_path: Path) -> None:
    rows = ball_rows(1)
    for row in rows:
        if row["known"] == 70 and row["method"] == "inverse-gp":
            row["rmse"] = float("nan") if row["set"] == "2R" else None
    rows = [row for row in rows if (row["set"], row["method"]) != ("2R4W", "mlp")]
    figure = paper.rmse_curves(rows)
    line = lines_of(figure.axes[0])["inverse-gp"].get_ydata()
    assert np.flatnonzero(np.isnan(line)).tolist() == [3]
    assert set(lines_of(figure.axes[2])) == {"inverse-gp"}
    for ending in ("png", "pdf"):
        figure.savefig(tmp_path / f"rmse.{ending}")
        assert (tmp_path / f"rmse.{ending}").stat().st_size > 5000


def test_one_run_without_splits() -> None:
    rows = [{"set": "2R", "method": "mlp", "known": 17, "run": 0, "rmse": 3.0, "mean_sd": None}]
    (axes,) = paper.rmse_curves(rows).axes
    assert lines_of(axes)["mlp"].get_ydata().tolist() == [3.0]
    (axes,) = paper.sd_curves(rows).axes
    assert [text.get_text() for text in axes.texts] == ["no result"]


@pytest.mark.parametrize("draw", [paper.rmse_curves, paper.sd_curves, paper.sd_against_rmse, paper.active_curves])
def test_nothing_is_a_figure_that_says_so(draw: Any, tmp_path: Path) -> None:
    figure = draw([])
    assert [text.get_text() for axes in figure.axes for text in axes.texts] == ["no result"]
    figure.savefig(tmp_path / "empty.png")


def test_only_explicit_lines() -> None:
    (axes,) = paper.rmse_curves(explicit_rows({"50+10": (2.0,), "7+3": (4.0,)})).axes
    assert set(lines_of(axes)) == {"explicit, 50 + 10 pictures", "explicit, 7 + 3 pictures"}


def test_sd_curves_have_a_line_for_each_set() -> None:
    rows = ball_rows(5, ("mlp", "forward-gp", "inverse-gp")) + explicit_rows({"50+10": (2.0,)})
    figure = paper.sd_curves(rows, total=175)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["inverse-gp", "forward-gp"]
    for axes in figure.axes:
        assert tuple(lines_of(axes)) == SETS
        for name, line in lines_of(axes).items():
            method = axes.get_title(loc="left")
            expected = [median(rows, "mean_sd", set=name, method=method, known=known) for known in SIZES]
            np.testing.assert_allclose(line.get_ydata(), expected)
    lines = lines_of(figure.axes[0]).values()
    assert len({(line.get_marker(), line.get_linestyle()) for line in lines}) == 3


def test_sd_against_rmse_has_its_honest_line_and_floor() -> None:
    rows = ball_rows(5) + explicit_rows({"50+10": (2.0, 4.0, 3.0), "10+4": (9.0,)})
    rows.append({"set": "2R", "method": "inverse-gp", "known": 17, "run": 9, "rmse": float("nan"), "mean_sd": 1.0})
    figure = paper.sd_against_rmse(rows, floor=10)
    axes = figure.axes[0]
    lines = lines_of(axes)
    honest = next(line for label, line in lines.items() if label.startswith("honest"))
    np.testing.assert_allclose(honest.get_xdata() / honest.get_ydata(), np.sqrt(3))
    assert lines["noise floor, 10 mm"].get_ydata()[0] == 10
    assert "mlp" not in lines
    np.testing.assert_allclose(lines["explicit"].get_xydata(), [[9.0, 3.0], [3.0, 1.0]])
    finite = [row for row in rows if np.isfinite(row["rmse"])]
    for key, shown in (("rmse", lines["inverse-gp"].get_xdata()), ("mean_sd", lines["inverse-gp"].get_ydata())):
        expected = [median(finite, key, set="2R", method="inverse-gp", known=known) for known in SIZES]
        np.testing.assert_allclose(shown, expected)
    dots = next(line for line in axes.lines if len(line.get_xdata()) == 5 * len(SIZES))
    mine = [(row["rmse"], row["mean_sd"]) for row in finite if (row["set"], row["method"]) == ("2R", "inverse-gp")]
    np.testing.assert_allclose(dots.get_xydata(), mine)
    assert "noise floor, 10 mm" not in lines_of(paper.sd_against_rmse(rows).axes[0])


def active_rows(methods: tuple[str, ...] = ("inverse-gp",), repeats: int = 5) -> list[dict[str, Any]]:
    return [
        {"set": name, "method": method, "repeat": k, "added": n, "max_sd": 9 + k - n / 20, "mean_sd": 3 + k - n / 50}
        for name in SETS for method in methods for k in range(repeats) for n in range(101)
    ]  # fmt: skip


def test_active_curves_have_a_line_for_each_repeat() -> None:
    figure = paper.active_curves(active_rows()[::-1])
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(SETS)
    for axes in figure.axes:
        solid = [line for line in axes.lines if line.get_linestyle() == "-"]
        dashed = [line for line in axes.lines if line.get_linestyle() == "--"]
        for k, (largest, mean) in enumerate(zip(solid, dashed, strict=True)):
            np.testing.assert_array_equal(largest.get_xdata(), np.arange(101))
            np.testing.assert_allclose(largest.get_ydata(), 9 + k - np.arange(101) / 20)
            np.testing.assert_allclose(mean.get_ydata(), 3 + k - np.arange(101) / 50)
        assert len(solid) == 5
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "largest of the points left", "mean of the points left"
    ]  # fmt: skip


def test_active_curves_of_several_methods_and_of_one_repeat_cut_short() -> None:
    rows = [row for row in active_rows(("forward-gp", "inverse-gp"), 1) if row["set"] != "2R" or row["added"] < 5]
    rows = [row for row in rows if (row["set"], row["method"]) != ("2R4W", "forward-gp")]
    rows[2]["max_sd"] = None
    figure = paper.active_curves(rows)
    assert len(figure.axes) == 6
    assert [len(axes.lines) for axes in figure.axes] == [2, 2, 2, 2, 2, 0]
    line = figure.axes[3].lines[0].get_ydata()
    assert np.flatnonzero(np.isnan(line)).tolist() == [2]
    assert figure.axes[5].texts[0].get_text() == "no result"


# ---------------------------------------------------------------------------------------------------------------- 3D


def panel(n: int = 18, *, seed: int = 0, sd: bool = True, **more: Any) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    true = rng.uniform(0, 300, (n, 3))
    stated = rng.uniform(5, 120, n) if sd else None
    return {
        "title": "a method", "true_xyz": true, "xyz": true + rng.normal(size=(n, 3)) * 20, "sd": stated,
        "known_xyz": rng.uniform(0, 300, (40, 3)), **more,
    }  # fmt: skip


def scatter_of(axes: Any) -> Any:
    (scatter,) = [c for c in axes.collections if hasattr(c, "_offsets3d")]
    return scatter


def three_d(axes: Any) -> list[Any]:
    return [line for line in axes.lines if hasattr(line, "get_data_3d")]


def test_clouds_show_points_errors_and_lines_to_the_truth() -> None:
    one, other = panel(), panel(sd=False, title="network", seed=1)
    one["xyz"][3] = np.nan
    figure = panels3d.clouds([one, other])
    first, second, bar = figure.axes
    assert first.get_title() == "a method (1 not measured)"
    assert second.get_title() == "network"
    assert bar.get_ylabel() == "distance from the truth (mm)"
    scatter, i = scatter_of(first), np.arange(18) != 3
    np.testing.assert_allclose(np.transpose(scatter._offsets3d), one["xyz"][i])
    errors = np.linalg.norm(one["xyz"] - one["true_xyz"], axis=1)[i]
    np.testing.assert_allclose(scatter.get_array(), errors)
    known, lines, truth = (np.transpose(line.get_data_3d()) for line in three_d(first))
    np.testing.assert_allclose(known, one["known_xyz"])
    np.testing.assert_allclose(truth, one["true_xyz"][i])
    np.testing.assert_allclose(lines[0::3], one["xyz"][i])
    np.testing.assert_allclose(lines[1::3], one["true_xyz"][i])
    assert np.isnan(lines[2::3]).all()
    assert len(set(scatter_of(second).get_sizes())) == 1
    assert np.corrcoef(scatter.get_sizes(), one["sd"][i])[0, 1] > 0.9
    assert scatter.get_clim() == scatter_of(second).get_clim()  # one scale for all


def test_sizes_follow_the_papers_scale() -> None:
    sd = np.array([0.1, 10.0, 55.0, 100.0, 400.0, np.nan])
    np.testing.assert_allclose(BOARD_SCALES.diameters(sd, 6), [7, 7, 18.5, 30, 30, 7])
    np.testing.assert_allclose(BOARD_SCALES.diameters(None, 2), [7, 7])
    np.testing.assert_allclose(Scales(1.0, (2.0, 2.0)).diameters(np.array([1.0, 2.0, 3.0]), 3), [7, 7, 30])


def test_board_panels_are_twelve_with_every_tenth_point() -> None:
    rows = [
        panel(173, seed=b, set=name, boards=b, title=f"{name}, {b} boards") for name in SETS[::-1] for b in (9, 5, 3, 2)
    ]
    figure = panels3d.board_panels(rows)
    *axes, _ = figure.axes
    assert [a.get_title() for a in axes] == [f"{name}, {b} boards" for name in SETS for b in (2, 3, 5, 9)]
    for a, boards in zip(axes, (2, 3, 5, 9) * 3, strict=True):
        row = next(row for row in rows if row["boards"] == boards)
        scatter = scatter_of(a)
        np.testing.assert_allclose(np.transpose(scatter._offsets3d), row["xyz"][::10])
        assert scatter.get_clim() == (0, 100)
        ratio = np.sqrt(scatter.get_sizes()) / BOARD_SCALES.diameters(row["sd"][::10], 18)
        np.testing.assert_allclose(ratio, ratio[0])
    assert [t.get_text() for t in figure.legends[0].get_texts()][-3:] == ["sd 10 mm", "sd 55 mm", "sd 100 mm"]


def test_a_board_panel_that_is_missing_or_measured_nothing_is_told(tmp_path: Path) -> None:
    rows = [panel(30, set=name, boards=b, title=None) for name in SETS[:2] for b in (2, 3)][:3]
    rows = [{key: value for key, value in row.items() if key != "title"} for row in rows]
    rows[1]["xyz"] = np.full((30, 3), np.nan)
    figure = panels3d.board_panels(rows)
    titles = [axes.get_title() for axes in figure.axes[:4]]
    assert titles == ["2R, 2 boards", "2R, 3 boards (30 not measured)", "2R2W, 2 boards", "2R2W, 3 boards"]
    assert [text.get_text() for text in figure.axes[3].texts] == ["no result"]
    figure.savefig(tmp_path / "boards.png")


def test_a_blunder_does_not_shrink_the_room() -> None:
    near, far = panel(), panel()
    far["xyz"][5] += 1e6
    limits = [panels3d.clouds([p], scales=BOARD_SCALES).axes[0].get_xlim() for p in (near, far)]
    assert limits[1][1] - limits[1][0] <= limits[0][1] - limits[0][0] + 1
    assert panels3d.scales_of([panel(500), {**panel(1), "xyz": np.full((1, 3), 1e9)}]).error_top < 200


@pytest.mark.parametrize("n", [0, 1])
def test_few_points_in_3d(n: int, tmp_path: Path) -> None:
    small = panel(n, known_xyz=None)
    panels3d.clouds([small]).savefig(tmp_path / "few.png")
    assert interactive3d.panels_3d([small]).to_json()
    panels3d.clouds([]).savefig(tmp_path / "none.png")
    panels3d.board_panels([]).savefig(tmp_path / "none.pdf")
    assert interactive3d.panels_3d([]).to_json()


def test_aligned_shows_three_clouds_and_the_residuals(tmp_path: Path) -> None:
    true, moved, before = (np.random.default_rng(i).uniform(0, 100, (9, 3)) for i in range(3))
    moved = true + 0.01 * (moved - 50)
    moved[2] = np.nan
    figure = panels3d.draw_alignment(true, moved, before, camera="cam7")
    *clouds, residuals = three_d(figure.axes[0])
    for line, xyz in zip(clouds, (true, moved, before), strict=True):
        np.testing.assert_allclose(np.transpose(line.get_data_3d()), xyz)
    rms = np.sqrt(np.nanmean(np.sum((moved - true) ** 2, axis=1)))
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[:3] == ["robot's positions", "explicit, aligned", "explicit, in the frame of cam7"]
    assert texts[3] == f"residuals, {number(rms)} mm rms, × 10"
    ends = np.transpose(residuals.get_data_3d()).reshape(8, 3, 3)
    good = np.delete(np.arange(9), 2)
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], 10 * (moved - true)[good])
    assert len({line.get_marker() for line in clouds}) == 3
    figure.savefig(tmp_path / "aligned.pdf")
    assert len(three_d(panels3d.draw_alignment(true, moved).axes[0])) == 3
    *shown, _ = interactive3d.draw_alignment_3d(true, moved, before).data
    np.testing.assert_allclose(np.array([[t.x, t.y, t.z] for t in shown]), np.swapaxes([true, moved, before], 1, 2))


def test_panels_that_differ_tenfold_have_colours_by_factors(tmp_path: Path) -> None:
    rough = panel(40, seed=1)
    fine = {**rough, "xyz": rough["true_xyz"] + 0.01 * (rough["xyz"] - rough["true_xyz"])}
    assert panels3d.scales_of([rough, rough]).error_low == 0
    scales = panels3d.scales_of([rough, fine])
    assert 0 < scales.error_low < 0.05 * scales.error_top
    figure = panels3d.clouds([rough, fine])
    figure.savefig(tmp_path / "clouds.png")
    assert len([tick for tick in figure.axes[-1].get_yticks() if scales.error_low <= tick <= scales.error_top]) >= 2
    measured = interactive3d.panels_3d([rough, fine]).data[3]
    assert measured.marker.cmin == pytest.approx(np.log10(scales.error_low))
    assert "1" in measured.marker.colorbar.ticktext


def test_panels_that_share_an_axis_have_numbers_all_along_it() -> None:
    """One panel within a decade does not take the numbers of the others."""
    rows = [
        {"set": "2R", "method": method, "known": known, "mean_sd": sd, "run": 0}
        for method, size in (("forward-gp", 0.1), ("mlp", 15.0))
        for known, sd in ((17, 1.3 * size), (157, size))
    ]
    figure = paper.sd_curves(rows)
    figure.canvas.draw()
    axes = figure.axes[0]
    low, high = axes.get_ylim()
    ticks = zip(axes.get_yticks(), axes.get_yticklabels(), strict=False)
    shown = [label.get_text() for tick, label in ticks if low <= tick <= high]
    assert {"1", "10"} <= set(shown)


def test_interactive_panels_show_one_at_a_time_and_the_same_points() -> None:
    panels = [panel(30, title="one"), panel(30, title="two", seed=1, sd=False), panel(30, title="three", seed=2)]
    panels[0]["xyz"][10] = np.nan
    figure = interactive3d.panels_3d(panels, scales=BOARD_SCALES, every=10)
    per = len(figure.data) // 3
    assert [trace.visible for trace in figure.data] == [True] * per + [False] * 2 * per
    (menu,) = figure.layout.updatemenus
    assert [button.label for button in menu.buttons] == ["one (1 not measured)", "two", "three"]
    for i, button in enumerate(menu.buttons):
        assert button.args[0]["visible"] == [k // per == i for k in range(3 * per)]
    for i, kept in enumerate(([0, 20], [0, 10, 20], [0, 10, 20])):
        measured = figure.data[per * i + per - 1]
        np.testing.assert_allclose(np.transpose([measured.x, measured.y, measured.z]), panels[i]["xyz"][kept])
        error = np.linalg.norm(panels[i]["xyz"] - panels[i]["true_xyz"], axis=1)[kept]
        np.testing.assert_allclose(measured.marker.color, error)
        assert (measured.marker.cmin, measured.marker.cmax) == (0, 100)
        assert len(measured.text) == len(kept)
    np.testing.assert_allclose(figure.data[per - 1].marker.size, BOARD_SCALES.diameters(panels[0]["sd"][[0, 20]], 2))
    assert "stated sd – mm" in figure.data[2 * per - 1].text[0]


# --------------------------------------------------------------------------------------------------------- the page


class Reader(HTMLParser):
    """Tags, what they load, and the JSON."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.json = ""
        self._in_json = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [str(v) for k, v in attrs if k in ("src", "href", "action", "data", "poster") or k[:2] == "on"]
        self._in_json = dict(attrs).get("type") == "application/json"

    def handle_endtag(self, tag: str) -> None:
        self._in_json = False

    def handle_data(self, data: str) -> None:
        self.json += data if self._in_json else ""


def test_the_page_is_whole_and_loads_nothing() -> None:
    from plotly.offline import get_plotlyjs

    figure = interactive3d.panels_3d([panel(title=HOSTILE), panel(title="b")])
    text = interactive3d.html_page(figure, title=HOSTILE, caption=HOSTILE)
    read = Reader(text)
    assert read.loads == []
    assert (
        read.tags
        == ["html", "head", "meta", "meta", "meta", "title", "style", "script", "body", "h1", "div", "p"]
        + ["script"] * 2
    )
    own = text.replace(get_plotlyjs(), "")
    assert len(own) < len(text) - 1e6
    assert "//" not in own.replace("</", "")
    assert "default-src 'none'" in own
    assert "<" not in read.json
    assert len(json.loads(read.json)["data"]) == len(figure.data)
    assert "<img" not in str(json.loads(read.json))  # Plotly shows entities as text, and tags as tags
    again = interactive3d.panels_3d([panel(title=HOSTILE), panel(title="b")])
    assert interactive3d.html_page(again, title=HOSTILE, caption=HOSTILE) == text


@pytest.mark.slow
@pytest.mark.browser
def test_the_page_draws_in_a_browser(tmp_path: Path, chromium: dict[str, Any]) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    file = tmp_path / "boards.html"
    rows = [panel(60, title=f"{name}, {b} boards") for name in SETS for b in (2, 3, 5, 9)]
    figure = interactive3d.panels_3d(rows, scales=BOARD_SCALES, every=10)
    file.write_text(interactive3d.html_page(figure, title="twelve panels"), encoding="utf-8")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(**chromium)
        try:
            view = browser.new_page(viewport={"width": 1100, "height": 800})
            told: list[str] = []
            asked: list[str] = []
            view.on("console", lambda message: told.append(message.text) if message.type == "error" else None)
            view.on("pageerror", lambda error: told.append(str(error)))
            view.on("request", lambda request: asked.append(request.url))
            view.goto(file.as_uri())
            view.wait_for_selector("#plot canvas", timeout=30_000)
            visible = "document.getElementById('plot').data.map(t => t.visible)"
            assert view.evaluate(visible) == [True] * 4 + [False] * 44
            view.click(".updatemenu-header")
            view.get_by_text("2R4W, 9 boards").click()
            view.wait_for_function(f"{visible}.indexOf(true) === 44")
            assert view.evaluate(visible) == [False] * 44 + [True] * 4
            assert told == []
            assert asked == [file.as_uri()]
        finally:
            browser.close()


def test_missing_libraries_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    monkeypatch.setitem(__import__("sys").modules, "plotly.graph_objects", None)
    for draw in (lambda: paper.rmse_curves(ball_rows(1)), lambda: panels3d.clouds([panel()])):
        with pytest.raises(MissingExtraError, match=r"implicam\[report\]"):
            draw()
    with pytest.raises(MissingExtraError, match=r"implicam\[report\]"):
        interactive3d.panels_3d([panel()])
