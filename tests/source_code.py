"""The project's source as data, for tests that hold its rules."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
FunctionNode = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Module:
    """One source file."""

    name: str
    path: Path
    text: str
    tree: ast.Module

    @property
    def package(self) -> str:
        """The folder below ``pipeline``, empty for a module directly in it."""
        parts = self.path.relative_to(CHECKOUT).parts
        return parts[1] if len(parts) > 2 else ""


@dataclass(frozen=True)
class Import:
    """One imported name, fully dotted: ``from a import b`` is ``a.b``."""

    target: str
    line: int

    @property
    def root(self) -> str:
        return self.target.split(".")[0]


@cache
def modules(folder: str = "pipeline") -> tuple[Module, ...]:
    return tuple(_module(path) for path in sorted((CHECKOUT / folder).rglob("*.py")))


def _module(path: Path) -> Module:
    text = path.read_text()
    parts = path.relative_to(CHECKOUT).with_suffix("").parts
    name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    return Module(name, path, text, ast.parse(text))


def imports(module: Module) -> Iterator[Import]:
    """Every import, also those inside functions; relative ones are made absolute."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            yield from (Import(alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                up = module.name.split(".")[: -node.level] if module.path.name != "__init__.py" else [module.name]
                base = ".".join([*up, base]).rstrip(".")
            yield from (Import(f"{base}.{alias.name}", node.lineno) for alias in node.names)


def functions(module: Module) -> Iterator[FunctionNode]:
    return (node for node in ast.walk(module.tree) if isinstance(node, FunctionNode))


def lines_of(function: FunctionNode) -> int:
    """Lines of a function without its docstring, blank lines not counted apart."""
    assert function.end_lineno is not None
    docstring = function.body[0] if ast.get_docstring(function) is not None else None
    documented = 0 if docstring is None else (docstring.end_lineno or 0) - docstring.lineno + 1
    return function.end_lineno - function.lineno + 1 - documented


def arguments_of(function: FunctionNode) -> int:
    """Number of arguments, ``self`` and ``cls`` not counted."""
    given = function.args
    names = [argument.arg for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])
