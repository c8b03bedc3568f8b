import subprocess
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.text import Text

from csac.record.plots import Curve, encoded, figure_of, learning_curve, looks_of


def evaluations(seeds=3, points=20, interval=5000, height=1000.0):
    """Rows of evaluations.csv, one episode per seed and point, rising towards `height`."""
    generator = np.random.default_rng(0)
    rows = [
        (seed, (point + 1) * interval, height * point / points + generator.normal(0, height / 30))
        for point in range(points)
        for seed in range(seeds)
    ]
    return np.array(rows, [("seed", np.int64), ("step", np.int64), ("return", np.float64)])


def axes_of(*runs, **options):
    return figure_of(runs, **options).axes[0]


def band(axes, step):
    """Where the only band is at a step."""
    (area,) = axes.collections
    heights = [y for x, y in area.get_paths()[0].vertices if x == step]
    return min(heights), max(heights)


def note(axes):
    return axes.figure.legends[0].get_title().get_text().replace("\n", " ")


def test_equal_rows_give_equal_files_whatever_the_users_style(tmp_path):
    for kind, start in (("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")):
        one, other = tmp_path / f"one.{kind}", tmp_path / f"other.{kind}"
        learning_curve([("csac", evaluations())], one, "Ant-v4")
        with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black", "savefig.transparent": True}):
            learning_curve([("csac", evaluations())], other, "Ant-v4")
        assert one.read_bytes().startswith(start)
        assert one.read_bytes() == other.read_bytes()


def test_three_seeds_are_shown_with_their_range_and_their_mean():
    rows = evaluations(seeds=3, points=4)
    axes = axes_of(("csac", rows))
    *single, mean = axes.lines
    by_seed = rows["return"].reshape(4, 3).T
    np.testing.assert_allclose(np.array([np.asarray(line.get_ydata()) for line in single]), by_seed)
    np.testing.assert_allclose(np.asarray(mean.get_ydata()), by_seed.mean(axis=0))
    np.testing.assert_array_equal(np.asarray(mean.get_xdata()), [5000, 10000, 15000, 20000])
    for step, returns in zip((5000, 10000, 15000, 20000), by_seed.T, strict=True):
        assert band(axes, step) == pytest.approx((returns.min(), returns.max()))
    assert note(axes) == "line: mean over seeds · thin: single seeds · band: range of seeds"


def test_five_seeds_are_shown_by_their_mean_and_its_interval():
    rows = evaluations(seeds=5, points=1)
    rows["return"] = [2.0, 4.0, 6.0, 8.0, 10.0]  # t(0.975, 4) sqrt(10 / 5) = 2.776445 * 1.414214 = 3.926486
    axes = axes_of(("csac", rows))
    assert len(axes.lines) == 1
    assert band(axes, 5000) == pytest.approx((6 - 3.926486, 6 + 3.926486))
    assert note(axes) == "line: mean over seeds · band: 95 % t-interval"


def test_one_and_two_seeds_have_no_band():
    two, one = axes_of(("csac", evaluations(seeds=2))), axes_of(("csac", evaluations(seeds=1)))
    assert [(len(axes.lines), len(axes.collections)) for axes in (two, one)] == [(3, 0), (1, 0)]
    assert (note(two), note(one)) == ("line: mean over seeds · thin: single seeds", "")


def test_a_picture_of_few_and_many_seeds_says_which_band_is_which():
    axes = axes_of(("few", evaluations(3)), ("many", evaluations(5)))
    assert note(axes).endswith("band: range of seeds · band from 5 seeds: 95 % t-interval")


def test_every_run_is_in_the_legend_under_its_own_label_and_look():
    labels = [f"relative_entropy_weight = {number}" for number in range(8)] + ["_hidden", "$x$"]
    legend = axes_of(*((label, evaluations(2)) for label in labels)).figure.legends[0]
    assert [text.get_text() for text in legend.get_texts()] == [f"{label} (2 seeds)" for label in labels]
    assert len({(line.get_color(), line.get_linestyle()) for line in legend.get_lines()}) == len(labels)


def test_all_text_is_in_the_picture():
    title = "PyFlyt/QuadX-Waypoints-v1: CSAC's reference policies, friction x 2.5 after step 300,000"
    labels = [f"CSAC (periodic), tau {tau:g}" for tau in (0.005, 0.05, 0.5, 5, 50, 500, 5000)]
    figure = figure_of([(label, evaluations(5 if index else 3)) for index, label in enumerate(labels)], title)
    encoded(figure)
    shown = {" ".join(text.get_text().split()): text.get_window_extent() for text in figure.findobj(Text)}
    for box in [shown[title], shown["return per evaluation episode"], figure.legends[0].get_window_extent()]:
        assert 0 <= box.x0 < box.x1 <= 1200
        assert 0 <= box.y0 < box.y1 <= figure.bbox.y1
    assert figure.axes[0].get_window_extent().height > 0.3 * figure.bbox.height


def test_a_label_has_one_look_wherever_it_is_drawn():
    looks = looks_of(["a", "b", "c"])
    assert len(set(looks_of(map(str, range(28))).values())) == 28
    assert axes_of(("c", evaluations()), looks=looks).lines[-1].get_color() == looks["c"][0]


def test_where_few_seeds_are_left_there_is_no_interval():
    rows = evaluations(seeds=5, points=3)
    curve = Curve.of("csac", rows[(rows["step"] < 15_000) | (rows["seed"] < 2)])
    assert np.isfinite(curve.mean).all()
    assert np.isnan(curve.high).tolist() == np.isnan(curve.low).tolist() == [False, False, True]


def test_marks_are_vertical_lines_with_their_text():
    axes = axes_of(("csac", evaluations(1)), marks=[(30_000, "friction × 1.5")])
    assert np.asarray(axes.lines[-1].get_xdata()).tolist() == [30_000, 30_000]
    assert [text.get_text() for text in axes.texts] == ["friction × 1.5"]


def test_a_seed_that_ended_early_and_a_single_point_are_drawn():
    rows = evaluations(seeds=2, points=3)
    *_, mean, first, second, point = axes_of(("csac", rows[:-1]), ("sac", rows[:2])).lines
    assert np.asarray(mean.get_ydata())[-1] == rows["return"][-2]
    assert [line.get_marker() for line in (first, second, point)] == ["o", "o", "o"]


def test_pictures_need_neither_pyplot_nor_jax():
    code = (
        "import sys, csac.record.plots; print([name for name in ('matplotlib.pyplot', 'jax') if name in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"
