import os
import subprocess
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from csac.record.plots import Panel, learning_curve, learning_curves, looks_of


def evaluations(seeds=3, points=20, interval=5000, height=1000.0, generator_seed=0):
    """Rows of evaluations.csv, one episode per seed and point, rising towards `height`."""
    generator = np.random.default_rng(generator_seed)
    rows = [
        (seed, (point + 1) * interval, height * point / points + generator.normal(0, height / 30))
        for point in range(points)
        for seed in range(seeds)
    ]
    return np.array(rows, [("seed", np.int64), ("step", np.int64), ("return", np.float64)])


@pytest.fixture
def figures(monkeypatch):
    """The figures that are drawn, in order."""
    drawn = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (drawn.append(self), save(self, *a, **k))[1])
    return drawn


def band(axes, step):
    """Where the only band is at a step."""
    (area,) = axes.collections
    heights = [y for x, y in area.get_paths()[0].vertices if x == step]
    return min(heights), max(heights)


def test_equal_rows_give_equal_files_whatever_the_users_style(tmp_path):
    learning_curve([("csac", evaluations())], tmp_path / "a.png", "Ant-v4", formats=("png", "pdf", "svg"))
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black", "savefig.transparent": True}):
        learning_curve([("csac", evaluations())], tmp_path / "b.png", "Ant-v4", formats=("png", "pdf", "svg"))
        assert matplotlib.rcParams["font.size"] == 30
    for kind, start in ((".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")):
        content = (tmp_path / f"a{kind}").read_bytes()
        assert content.startswith(start)
        assert content == (tmp_path / f"b{kind}").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.pdf", "a.png", "a.svg", "b.pdf", "b.png", "b.svg"]


def test_three_seeds_are_shown_with_their_range_and_their_mean(tmp_path, figures):
    rows = evaluations(seeds=3, points=4)
    learning_curve([("csac", rows)], tmp_path / "curve.png", "Ant-v4")
    axes = figures[0].axes[0]
    *single, mean = axes.lines
    by_seed = rows["return"].reshape(4, 3).T
    np.testing.assert_allclose([line.get_ydata() for line in single], by_seed)
    np.testing.assert_allclose(mean.get_ydata(), by_seed.mean(axis=0))
    np.testing.assert_array_equal(mean.get_xdata(), [5000, 10000, 15000, 20000])
    assert mean.get_linewidth() > single[0].get_linewidth()
    for step, returns in zip((5000, 10000, 15000, 20000), by_seed.T, strict=True):
        assert band(axes, step) == pytest.approx((returns.min(), returns.max()))
    assert axes.texts[0].get_text() == "line: mean over seeds · thin: single seeds · band: their range"


def test_five_seeds_are_shown_by_their_mean_and_its_interval(tmp_path, figures):
    rows = evaluations(seeds=5, points=1)
    rows["return"] = [2.0, 4.0, 6.0, 8.0, 10.0]  # t(0.975, 4) sqrt(10 / 5) = 2.776445 * 1.414214 = 3.926486
    learning_curve([("csac", rows)], tmp_path / "curve.png")
    axes = figures[0].axes[0]
    assert len(axes.lines) == 1
    assert band(axes, 5000) == pytest.approx((6 - 3.926486, 6 + 3.926486))
    assert axes.texts[0].get_text() == "line: mean over seeds · band: 95 % t-interval"


def test_two_seeds_have_no_band(tmp_path, figures):
    learning_curve([("csac", evaluations(seeds=2))], tmp_path / "curve.png")
    axes = figures[0].axes[0]
    assert (len(axes.lines), len(axes.collections)) == (3, 0)
    assert axes.texts[0].get_text() == "line: mean over seeds · thin: single seeds"


def test_a_picture_of_few_and_many_seeds_says_which_band_is_which(tmp_path, figures):
    learning_curve([("few", evaluations(3)), ("many", evaluations(5))], tmp_path / "curve.png")
    note = "line: mean over seeds · thin: single seeds · band: their range, from 5 seeds 95 % t-interval"
    assert figures[0].axes[0].texts[0].get_text().replace("\n", " · ") == note


def test_one_seed_has_neither_band_nor_thin_lines(tmp_path, figures):
    learning_curve([("csac", evaluations(seeds=1))], tmp_path / "curve.png")
    axes = figures[0].axes[0]
    assert (len(axes.lines), len(axes.collections), len(axes.texts)) == (1, 0, 0)


def test_every_run_is_in_the_legend_under_its_own_label_and_look(tmp_path, figures):
    labels = [f"relative_entropy_weight = {number}" for number in range(8)] + ["_hidden", "$x$"]
    learning_curve([(label, evaluations(2)) for label in labels], tmp_path / "curve.png")
    legend = figures[0].legends[0]
    assert [text.get_text() for text in legend.get_texts()] == [f"{label} (2 seeds)" for label in labels]
    looks = {(line.get_color(), line.get_linestyle()) for line in legend.get_lines()}
    assert len(looks) == len(labels)
    box = legend.get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figures[0].bbox.x1


LABELS = [f"CSAC (periodic), tau {tau:g}" for tau in (0.005, 0.05, 0.5, 5, 50, 500, 5000)]
TITLE = "PyFlyt/QuadX-Waypoints-v1: CSAC's reference policies, friction x 2.5 after step 300,000"


@pytest.mark.parametrize("columns", [1, 3])
def test_all_text_is_in_the_picture(tmp_path, figures, columns):
    runs = [(label, evaluations(5 if index else 3, height=12_000)) for index, label in enumerate(LABELS)]
    learning_curves([Panel(runs, f"friction x {column}") for column in range(columns)], tmp_path / "a.png", TITLE)
    (figure,) = figures
    shown = {" ".join(text.get_text().split()): text.get_window_extent() for text in figure.findobj(Text)}
    title, note = shown[TITLE], next(box for text, box in shown.items() if text.startswith("line: mean over seeds"))
    for box in [title, note, shown["return per evaluation episode"], figure.legends[0].get_window_extent()]:
        assert 0 <= box.x0 < box.x1 <= 1200
        assert 0 <= box.y0 < box.y1 <= figure.bbox.y1
    two_lines = 2 * 13 / 72 * figure.dpi
    assert title.y1 - two_lines > note.y1 > note.y0 > figure.axes[0].get_window_extent().y1
    assert figure.axes[0].get_window_extent().height > 0.3 * figure.bbox.height


def test_text_can_be_read_in_a_column(tmp_path, figures):
    """Of 3.4 inches: no smaller than 6 points, and the picture still has its pixels."""
    path = tmp_path / "curve.png"
    learning_curve([("csac", evaluations())], path, "Ant-v4")
    (axes,) = figures[0].axes
    texts = [axes.title, axes.xaxis.label, *axes.texts, *axes.get_xticklabels(), *figures[0].legends[0].get_texts()]
    assert min(text.get_fontsize() for text in texts) * 3.4 / figures[0].get_figwidth() > 6
    assert int.from_bytes(path.read_bytes()[16:20]) == 1200  # the width, as the PNG's header has it


def test_a_label_has_one_look_wherever_it_is_drawn(tmp_path, figures):
    looks = looks_of(["a", "b", "c"])
    assert looks_of(["c", "a"], looks) == {"c": looks["c"], "a": looks["a"]}
    assert looks_of(["new", "b", "newer"], looks) == {"new": looks["a"], "b": looks["b"], "newer": looks["c"]}
    assert len(set(looks_of(map(str, range(28))).values())) == 28
    learning_curves([Panel([("c", evaluations())])], tmp_path / "curve.png", looks=looks)
    assert figures[0].legends[0].get_lines()[0].get_color() == looks["c"][0]


def test_a_band_stays_within_the_limits_of_what_is_drawn(tmp_path, figures):
    rows = evaluations(seeds=5, points=2)
    rows["return"] = [0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0]  # 0.6 ± 0.68 and 0.8 ± 0.56
    learning_curves([Panel([("csac", rows)])], tmp_path / "curve.png", within=(0.0, 1.0))
    axes = figures[0].axes[0]
    assert band(axes, 5000) == (0.0, 1.0)
    assert band(axes, 10_000) == pytest.approx((0.8 - 0.5553, 1.0), abs=1e-4)  # t(0.975, 4) * 0.4472 / sqrt(5)
    assert axes.get_ylim() == pytest.approx((-0.05, 1.05))


def test_a_wide_band_does_not_flatten_the_curves(tmp_path, figures):
    rows = evaluations(seeds=5, points=2)
    rows["return"] = [0.0, 0.0, 0.0, 0.0, 100.0] * 2  # the band reaches to 20 ± 56
    learning_curve([("csac", rows)], tmp_path / "curve.png")
    assert figures[0].axes[0].get_ylim()[0] == -25.0


def test_marks_are_vertical_lines_with_their_text(tmp_path, figures):
    learning_curve([("csac", evaluations(1))], tmp_path / "curve.png", marks=[(30_000, "friction × 1.5")])
    axes = figures[0].axes[0]
    assert list(axes.lines[-1].get_xdata()) == [30_000, 30_000]
    assert [text.get_text() for text in axes.texts] == ["friction × 1.5"]


def test_a_seed_that_ended_early_and_a_single_point_are_drawn(tmp_path, figures):
    rows = evaluations(seeds=2, points=3)
    learning_curve([("csac", rows[:-1]), ("sac", rows[:2])], tmp_path / "curve.png")
    *_, mean, first, second, point = figures[0].axes[0].lines
    assert mean.get_ydata()[-1] == rows["return"][-2]
    assert [line.get_marker() for line in (first, second, point)] == ["o", "o", "o"]


def test_an_evaluation_before_the_first_step_is_drawn(tmp_path, figures):
    learning_curve([("csac", evaluations(seeds=2, points=1, interval=0))], tmp_path / "curve.png")
    assert figures[0].axes[0].lines[-1].get_xdata() == [0]


@pytest.mark.parametrize("runs", [[], [("csac", evaluations(points=0))]])
def test_nothing_to_draw_is_said(tmp_path, figures, runs):
    learning_curve(runs, tmp_path / "curve.png", "Ant-v4")
    assert [text.get_text() for text in figures[0].axes[0].texts] == ["no evaluations yet"]


def test_pictures_need_neither_pyplot_nor_jax():
    code = (
        "import sys, csac.record.plots; print([name for name in ('matplotlib.pyplot', 'jax') if name in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


@pytest.mark.parametrize("module", ["plots"])
def test_a_wrong_choice_of_window_stops_no_picture(tmp_path, module):
    path = tmp_path / "curve.png"
    code = (
        f"import csac.record.{module}, os, numpy as np; from csac.record.plots import learning_curve; "
        f"learning_curve([], {str(path)!r}); print(os.environ['MPLBACKEND'])"
    )
    environment = {**os.environ, "MPLBACKEND": "no_such_window"}
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert answer.stdout.strip() == "no_such_window"
    assert path.read_bytes().startswith(b"\x89PNG")
