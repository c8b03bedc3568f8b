"""The hyperparameters of a study as its cells have them, task by task, and the paper's beside them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from csac.record.rendering import Cell, Row, Table
from csac.studies import paper
from csac.studies.parts import Heading, Paragraph
from csac.studies.sections import SYMBOLS, plain

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from csac.studies.parts import Part
    from csac.studies.study import Study

# What the rows of the paper's table are called here: an algorithm has some of these names.
_NAMES: Mapping[str, tuple[str, ...]] = {
    "Critic Learning Rate": ("critic_learning_rate", "learning_rate"),
    "Actor Learning Rate": ("actor_learning_rate", "learning_rate"),
    "Actor and Critic Structure": ("critic_hidden_sizes", "actor_hidden_sizes", "hidden_sizes"),
    "Target Update Rate": ("target_rate",),
    "Batch Size": ("batch_size",),
    "Memory Size": ("replay_size",),
    "Warmup Steps": ("warmup_steps",),
    "Discount Factor": ("discount",),
}
_WEIGHTS: Mapping[str, str] = {symbol: name for name, symbol in SYMBOLS.items()}
_BY_TASK = "by task"
_PPO_BATCH = "PPO's batch is its rollout divided by its minibatches: the paper's 32 is read as the number of these."
_SHORTENED = (
    "Warm-up is a tenth of a shortened run at most, and told as it ran; runs are evaluated twenty times at least."
)

Settings = dict[str, dict[str, Any]]  # of one method: its hyperparameters by task


def hyperparameters(study: Study) -> Iterator[Part]:
    """Yield the paper's table where the study has its methods, all hyperparameters, and those that hang on the task."""
    yield Heading("Hyperparameters")
    settings: dict[str, Settings] = {}
    for entry in study.narrowed(seeds=1).entries():
        settings.setdefault(entry.method.label, {})[entry.cell.task] = entry.cell.hyperparameters
    if published := {method.label: method.published for method in study.methods if method.published}:
        yield from _beside_the_paper(published, settings)
    yield _all(settings, study.tasks)
    if differing := _by_task(settings, study.tasks):
        yield differing
    if study.scale < 1:
        yield Paragraph(_SHORTENED)


def _beside_the_paper(published: Mapping[str, str], settings: Mapping[str, Settings]) -> Iterator[Part]:
    """Yield the paper's rows for each method, by its label, that stands beside a column of the paper."""
    rows, others = [], []
    for name in (*_NAMES, *_WEIGHTS):
        cells = []
        for label, column in published.items():
            pairs = {task: (_ours(name, own), _papers(name, column, task)) for task, own in settings[label].items()}
            differs = any(theirs is not None and not _is_same(ours, theirs) for ours, theirs in pairs.values())
            others += [f"{name} of {label}"] * differs
            cells.append(_grouped({task: _told(*pair) for task, pair in pairs.items()}))
        rows.append(Row((Cell(name), *cells)))
    yield Table(("the paper's rows, our values", *published), tuple(rows))
    told = f"Different from the paper's: {', '.join(others)}." if others else "All are the paper's."
    yield Paragraph(told + f" {_PPO_BATCH}" * ("Batch Size of PPO" in others))


def _all(settings: Mapping[str, Settings], tasks: Sequence[str]) -> Table:
    """Return every hyperparameter of every method, or that it hangs on the task."""
    names = dict.fromkeys(name for own in settings.values() for name in own[tasks[0]])
    rows = []
    for name in names:
        values = [{plain(own[task].get(name)) for task in tasks} for own in settings.values()]
        cells = (Cell(next(iter(some)) if len(some) == 1 else _BY_TASK) for some in values)
        rows.append(Row((Cell(name), *cells)))
    return Table((f"on {tasks[0]}" if len(tasks) == 1 else "on every task", *settings), tuple(rows))


def _by_task(settings: Mapping[str, Settings], tasks: Sequence[str]) -> Table | None:
    """Return the hyperparameters that are not the same on every task, None where there is none."""
    rows = []
    for label, own in settings.items():
        for name in own[tasks[0]]:
            values = [plain(own[task].get(name)) for task in tasks]
            if len(set(values)) > 1:
                rows.append(Row((Cell(label), Cell(name), *map(Cell, values))))
    return Table(("by task", "", *tasks), tuple(rows)) if rows else None


def _ours(name: str, own: Mapping[str, Any]) -> list[Any]:
    """Return what a row of the paper's table is in ours: nothing where the method has none of it."""
    if name == "Batch Size" and "minibatches" in own:
        return [own["rollout_steps"] // own["minibatches"]]
    if name in _WEIGHTS and "relative_entropy_weight" not in own:
        return []  # the paper's sigma and tau are CSAC's
    names = (_WEIGHTS[name],) if name in _WEIGHTS else _NAMES[name]
    return list(dict.fromkeys(own[one] for one in names if one in own))


def _papers(name: str, published: str, task: str) -> str | None:
    """Return what the paper says, None where it says nothing. What a study sweeps is one of the paper's weights too."""
    column = published if published in paper.METHODS else "CSAC"
    if name in _NAMES:
        return paper.HYPERPARAMETERS[name][column]
    if column != "CSAC" or task not in paper.WEIGHTS:
        return None
    if name == "tau" and published != "CSAC":
        return published.removeprefix("tau ")
    return f"{getattr(paper.WEIGHTS[task], name):g}"


def _is_same(ours: Sequence[Any], theirs: str) -> bool:
    numbers = tuple(float(word) for word in theirs.strip("()").split(","))
    return [tuple(one) if isinstance(one, tuple) else (one,) for one in ours] == [numbers]


def _told(ours: Sequence[Any], theirs: str | None) -> str:
    text = ", ".join(map(plain, ours))
    if theirs is None or _is_same(ours, theirs):
        return text
    return f"{text or 'none'} (the paper: {theirs})"


def _grouped(texts: Mapping[str, str]) -> Cell:
    """Return one text for all tasks, or each with its tasks."""
    by_text: dict[str, list[str]] = {}
    for task, text in texts.items():
        by_text.setdefault(text, []).append(task)
    if len(by_text) == 1:
        return Cell(next(iter(by_text)))
    return Cell("; ".join(f"{text} on {', '.join(tasks)}" for text, tasks in by_text.items()))
