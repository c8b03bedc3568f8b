import subprocess
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from csac.record import plots
from csac.record.plots import learning_curve


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


def test_equal_rows_give_equal_files_whatever_the_users_style(tmp_path):
    learning_curve([("csac", evaluations())], tmp_path / "a.png", "Ant-v4", pdf=True)
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black", "savefig.transparent": True}):
        learning_curve([("csac", evaluations())], tmp_path / "b.png", "Ant-v4", pdf=True)
        assert matplotlib.rcParams["font.size"] == 30
    for kind, start in ((".png", b"\x89PNG"), (".pdf", b"%PDF")):
        content = (tmp_path / f"a{kind}").read_bytes()
        assert content.startswith(start)
        assert content == (tmp_path / f"b{kind}").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.pdf", "a.png", "b.pdf", "b.png"]


def test_a_run_is_its_mean_its_band_and_its_seeds(tmp_path, figures):
    rows = evaluations(seeds=3, points=4)
    learning_curve([("csac", rows)], tmp_path / "curve.png", "Ant-v4")
    axes = figures[0].axes[0]
    assert len(axes.collections) == 1
    *single, mean = axes.lines
    by_seed = rows["return"].reshape(4, 3).T
    np.testing.assert_allclose([line.get_ydata() for line in single], by_seed)
    np.testing.assert_allclose(mean.get_ydata(), by_seed.mean(axis=0))
    np.testing.assert_array_equal(mean.get_xdata(), [5000, 10000, 15000, 20000])
    assert mean.get_linewidth() > single[0].get_linewidth()


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


def test_a_wide_band_does_not_flatten_the_curves(tmp_path, figures):
    rows = evaluations(seeds=2, points=2)
    rows["return"] = [0.0, 100.0, 0.0, 100.0]  # t(0.975, 1) = 12.7: the band reaches to 50 ± 635
    learning_curve([("csac", rows)], tmp_path / "curve.png")
    assert figures[0].axes[0].get_ylim() == pytest.approx((-25.0, 125.0))


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


@pytest.mark.parametrize(
    ("step", "text"), [(0, "0"), (500, "500"), (5000, "5k"), (12_500, "12.5k"), (1_000_000, "1M"), (1_500_000, "1.5M")]
)
def test_steps_are_written_as_people_say_them(step, text):
    assert plots._short(step) == text


def test_pictures_need_neither_pyplot_nor_jax():
    code = (
        "import sys, csac.record.plots; print([name for name in ('matplotlib.pyplot', 'jax') if name in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"
