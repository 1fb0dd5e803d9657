"""Which tests cover which row of the fault matrix, read off their marks."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parents[1] / "tests"


def marked_tests() -> dict[str, list[str]]:
    """Row of the matrix -> names of the tests that carry its mark, sorted."""
    found = defaultdict(set)
    for path in sorted(TESTS.rglob("test_*.py")):
        for name, row in _marks(ast.parse(path.read_text(encoding="utf-8"))):
            found[row].add(name)
    return {row: sorted(names) for row, names in found.items()}


def _marks(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Test name and row of every ``@pytest.mark.fault(...)``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            for mark in node.decorator_list:
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.fault":
                    yield from ((node.name, str(ast.literal_eval(argument))) for argument in mark.args)
