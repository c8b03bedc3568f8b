"""The code stays readable: short functions, short files, no circle of imports."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "csac").rglob("*.py"))
MODULES = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in FILES}
LONGEST_FUNCTION, LONGEST_FILE = 60, 350  # lines, docstrings of functions apart


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring."""
    first = function.body[0]
    has_text = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and ast.get_docstring(function)
    docstring = (first.end_lineno or 0) - first.lineno + 1 if has_text else 0
    return (function.end_lineno or 0) - function.lineno + 1 - docstring


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_functions_and_files_are_short(path):
    text = path.read_text()
    assert text.count("\n") <= LONGEST_FILE
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    assert {one.name: length(one) for one in functions if length(one) > LONGEST_FUNCTION} == {}


def imports_of(path: Path) -> set[str]:
    """Modules of csac that a file imports as it runs: those for type checkers alone do not count."""
    found = set()

    class Visitor(ast.NodeVisitor):
        def visit_If(self, node: ast.If) -> None:
            if not (isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
                self.generic_visit(node)

        def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
            module = node.module or ""
            below = {f"{module}.{name.name}" for name in node.names}
            found.update(below)
            if not below <= MODULES:
                found.add(module)

    Visitor().visit(ast.parse(path.read_text()))
    return {name for name in found if name.startswith("csac")}


def test_no_module_imports_itself_in_the_end():
    names = {path: ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in FILES}
    edges = {names[path]: imports_of(path) & set(names.values()) - {"csac"} for path in FILES if names[path] != "csac"}
    while leaves := [name for name, imported in edges.items() if not imported & edges.keys() - {name}]:
        for name in leaves:
            del edges[name]
    assert edges == {}
