"""What a stage's result depends on besides data: the meaning of the code it can reach, and package versions.

The digest is static. From the module of ``stage.run`` the import statements are followed inside its top-level package,
also those inside functions and under ``if``; of each module the syntax tree without docstrings and positions is hashed.
So an edited comment changes nothing, and an edited formula changes exactly the stages that can reach it. An import by a
name that is computed at run time is not seen.
"""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Iterator, Set
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from pipeline.engine.stage import Stage

#: Packages that decide numbers or bytes; an upgrade of one recomputes every stage.
NUMERIC_PACKAGES = (
    "numpy",
    "numba",
    "scipy",
    "vtk",
    "fast-simplification",
    "python-fcl",
    "trimesh",
    "SimpleITK",
    "opencv-python-headless",
    "meshio",
    "h5py",
    "matplotlib",
    "weasyprint",
    "nibabel",
    "pynrrd",
)

_ENGINE = __name__.rpartition(".")[0]
#: Of the engine itself only these decide bytes (how artifacts are named and encoded); how it runs stages does not.
_CONTRACT = tuple(f"{_ENGINE}.{name}" for name in ("artifacts", "records", "stage"))


@dataclass(frozen=True)
class Code:
    """Code that decides a result: module or ``package:file`` -> SHA-256.

    Attributes
    ----------
    meaning : dict of str to str
        Hash of the syntax tree without docstrings (of the bytes, for a resource).
    sources : dict of str to str
        Hash of the bytes, to find out quickly that nothing changed.
    """

    meaning: dict[str, str]
    sources: dict[str, str]


@dataclass(frozen=True)
class SourceTree:
    """One importable package as source text.

    Attributes
    ----------
    package : str
        Top-level name.
    root : Path
        Its folder, or the file of a package that is a single module.
    """

    package: str
    root: Path

    def find(self, module: str) -> Path | None:
        """The source file of a module, or None where it is no module of this package."""
        if module == self.package and self.root.is_file():
            return self.root
        base = self.root.joinpath(*module.split(".")[1:])
        candidates = (base / "__init__.py", base.with_suffix(".py"))
        inside = module.partition(".")[0] == self.package
        return next((path for path in candidates if inside and path.is_file()), None)

    def resource(self, name: str) -> Path:
        """The file of a resource ``package:file``."""
        package, _, file = name.partition(":")
        return self.root.joinpath(*package.split(".")[1:], file)


@dataclass(frozen=True)
class _Module:
    digest: str
    names: frozenset[str]  # what its import statements could mean, as dotted names


def source_tree(package: str) -> SourceTree:
    """The source of an importable top-level package.

    Raises
    ------
    ValueError
        When it has no source files.
    """
    spec = find_spec(package)
    if spec is not None and spec.submodule_search_locations:
        return SourceTree(package, Path(next(iter(spec.submodule_search_locations))))
    if spec is not None and spec.origin is not None:
        return SourceTree(package, Path(spec.origin))
    raise ValueError(f"no source found for package {package}")


def code_of(stage: Stage, earlier: Code | None = None, tree: SourceTree | None = None) -> Code:
    """The code that a stage's result depends on.

    Parameters
    ----------
    earlier : Code, optional
        What an earlier result depended on; taken over without parsing when none of those sources has changed, since
        what they import is then the same too.
    tree : SourceTree, optional
        Where the code is; by default the importable package that holds ``stage.run``.
    """
    start = stage.run.__module__
    tree = tree or source_tree(start.partition(".")[0])
    if earlier is not None and start in earlier.sources and _is_current(earlier, tree):
        return earlier
    files = dict(_reachable(start, tree)) | {name: _locate(name, tree) for name in (*_CONTRACT, *stage.resources)}
    data = {name: _read(path) for name, path in files.items()}
    meaning = {name: _meaning(name, source, files[name]) for name, source in data.items()}
    return Code(meaning, {name: _sha256(source) for name, source in data.items()})


@cache
def package_versions() -> dict[str, str]:
    """Version of Python (major.minor) and of each numeric package; ``absent`` where it is not installed."""
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    return {"Python": python, **{name: _version(name) for name in NUMERIC_PACKAGES}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


def _is_current(code: Code, tree: SourceTree) -> bool:
    return all(_sha256(_read(_locate(name, tree))) == known for name, known in code.sources.items())


def _locate(name: str, tree: SourceTree) -> Path | None:
    if name in _CONTRACT:
        return Path(__file__).with_name(f"{name.rpartition('.')[2]}.py")
    return tree.resource(name) if ":" in name else tree.find(name)


def _read(path: Path | None) -> bytes:
    return path.read_bytes() if path is not None and path.is_file() else b""


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _meaning(name: str, source: bytes, path: Path | None) -> str:
    is_resource = ":" in name or path is None
    return _sha256(source) if is_resource else _parsed(name, source, is_package=_is_package(path)).digest


def _is_package(path: Path | None) -> bool:
    return path is not None and path.name == "__init__.py"


def _reachable(start: str, tree: SourceTree) -> Iterator[tuple[str, Path]]:
    seen = _with_parents({start})
    waiting = sorted(seen)
    while waiting:
        name = waiting.pop()
        path = tree.find(name)
        if path is None or _is_engine(name):
            continue
        yield name, path
        names = _parsed(name, path.read_bytes(), is_package=_is_package(path)).names
        new = _with_parents(names) - seen
        seen |= new
        waiting.extend(sorted(new))


def _is_engine(module: str) -> bool:
    return module == _ENGINE or module.startswith(f"{_ENGINE}.")


def _with_parents(names: Set[str]) -> set[str]:
    # Importing a.b.c runs a.b as well. The root package is left out unless something is imported from it: it holds
    # the release number, which must not recompute every stage.
    parents = {name.rsplit(".", depth)[0] for name in names for depth in range(1, name.count("."))}
    return set(names) | parents


@lru_cache(maxsize=4096)
def _parsed(module: str, source: bytes, *, is_package: bool) -> _Module:
    syntax = ast.parse(source)
    nodes = list(ast.walk(syntax))
    package = module if is_package else module.rpartition(".")[0]
    names = frozenset(name for node in nodes for name in _imported(node, package))
    for node in nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [statement for statement in node.body if not _is_text(statement)]
    return _Module(_sha256(ast.dump(syntax).encode()), names)


def _imported(node: ast.AST, package: str) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = _import_base(node, package)
        yield base
        yield from (f"{base}.{alias.name}" for alias in node.names)


def _import_base(node: ast.ImportFrom, package: str) -> str:
    if node.level == 0:
        return node.module or ""
    parts = package.split(".")
    return ".".join([*parts[: len(parts) - node.level + 1], *filter(None, [node.module])])


def _is_text(statement: ast.stmt) -> bool:
    match statement:
        case ast.Expr(value=ast.Constant(value=str())):
            return True
        case _:
            return False
