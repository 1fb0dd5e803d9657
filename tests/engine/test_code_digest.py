"""An edited comment changes nothing; an edited formula changes exactly the stages that can reach it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.engine.code_digest import Code, SourceTree, code_of, package_versions, source_tree
from pipeline.engine.stage import Stage, StrictParams
from tests.engine.toy_flow import GATHER

PACKAGE = "toypackage"
FILES = {
    "__init__.py": '"""Toy."""\n__version__ = "1"\n',
    "maths/__init__.py": "",
    "maths/area.py": 'def area(r):\n    """Doc."""\n    # why\n    return 3.14 * r * r\n',
    "maths/length.py": "from toypackage.maths import constants\n\n\ndef length(r):\n    return constants.TWO * r\n",
    "maths/constants.py": "TWO = 2\n",
    "maths/lonely.py": "X = 1\n",
    "stages/__init__.py": "",
    "stages/one.py": "from toypackage.maths.area import area\n\n\ndef run(reads, params, out):\n    return area(1)\n",
    "stages/two.py": (
        "from ..maths import lonely as other\n\n\ndef run(reads, params, out):\n"
        "    import toypackage.maths.length as late\n    return late.length(other.X)\n"
    ),
    "stages/three.py": "from toypackage import __version__\n\n\ndef run(reads, params, out):\n    return __version__\n",
    "report/page.html": "<p>hello</p>",
}


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    for name, text in FILES.items():
        (tmp_path / PACKAGE / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / PACKAGE / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path / PACKAGE
    for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
        del sys.modules[name]


def digests(root: Path) -> dict[str, dict[str, str]]:
    tree = SourceTree(PACKAGE, root)
    stages = [make_stage(name) for name in ("one", "two", "three")]
    return {stage.name: code_of(stage, tree=tree).meaning for stage in stages}


def make_stage(name: str) -> Stage:
    run = importlib.import_module(f"{PACKAGE}.stages.{name}").run
    resources = (f"{PACKAGE}.report:page.html",) if name == "three" else ()
    return Stage(10, name, (), (), StrictParams, run, resources)


def changed_by(root: Path, file: str, old: str, new: str) -> set[str]:
    before = digests(root)
    path = root / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    after = digests(root)
    return {stage for stage in before if before[stage] != after[stage]}


def test_a_stage_depends_on_what_its_imports_reach(root: Path) -> None:
    reached = {
        stage: {name.removeprefix(f"{PACKAGE}.") for name in found if name.startswith(PACKAGE)}
        for stage, found in digests(root).items()
    }
    assert reached == {
        "one": {"stages", "stages.one", "maths", "maths.area"},
        "two": {"stages", "stages.two", "maths", "maths.lonely", "maths.length", "maths.constants"},
        "three": {"stages", "stages.three", PACKAGE, "report:page.html"},
    }


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("maths/area.py", "# why", "# because"),
        ("maths/area.py", '"""Doc."""', '"""Other words."""'),
        ("maths/area.py", '    """Doc."""\n', ""),
        ("maths/area.py", "3.14 * r * r", "(3.14 * r\n            * r)"),
        ("__init__.py", "Toy.", "Game."),
        ("stages/one.py", "\n\n\ndef", "\n\n\n\n\n# far\ndef"),
    ],
)
def test_comments_docstrings_and_layout_change_nothing(root: Path, file: str, old: str, new: str) -> None:
    assert changed_by(root, file, old, new) == set()


@pytest.mark.parametrize(
    ("file", "old", "new", "stages"),
    [
        ("maths/area.py", "3.14", "3.14159", {"one"}),
        ("maths/area.py", "r * r", "r + r", {"one"}),
        ("maths/constants.py", "2", "2.0", {"two"}),
        ("maths/lonely.py", "1", "-1", {"two"}),
        ("maths/__init__.py", "", "import os\n", {"one", "two"}),
        ("stages/two.py", "late.length(other.X)", "other.X", {"two"}),
        ("__init__.py", '"1"', '"2"', {"three"}),
        ("report/page.html", "hello", "hallo", {"three"}),
    ],
)
def test_a_formula_changes_exactly_the_stages_that_reach_it(
    root: Path, file: str, old: str, new: str, stages: set[str]
) -> None:
    assert changed_by(root, file, old, new) == stages


def test_the_engine_counts_only_by_what_decides_bytes() -> None:
    engine = {name for name in code_of(GATHER).meaning if name.startswith("pipeline.engine")}
    assert engine == {"pipeline.engine.artifacts", "pipeline.engine.records", "pipeline.engine.stage"}


def test_the_package_of_a_stage_is_found_by_import(root: Path) -> None:
    stage = make_stage("one")
    assert source_tree(PACKAGE) == SourceTree(PACKAGE, root)
    assert code_of(stage) == code_of(stage, tree=SourceTree(PACKAGE, root))
    with pytest.raises(ValueError, match="no source found for package no_such_package"):
        source_tree("no_such_package")


def test_what_an_earlier_result_knew_is_taken_over_only_while_no_source_changed(root: Path) -> None:
    stage, tree = make_stage("one"), SourceTree(PACKAGE, root)
    fresh = code_of(stage, tree=tree)
    marked = Code(dict.fromkeys(fresh.meaning, "known"), fresh.sources)
    assert code_of(stage, marked, tree) == marked
    assert code_of(make_stage("two"), marked, tree) == code_of(make_stage("two"), tree=tree)
    (root / "maths/area.py").write_text(FILES["maths/area.py"] + "# comment\n")
    assert code_of(stage, marked, tree).meaning == fresh.meaning
    (root / "maths/area.py").unlink()
    assert set(code_of(stage, marked, tree).meaning) == set(fresh.meaning) - {f"{PACKAGE}.maths.area"}


def test_versions_name_python_and_every_numeric_package() -> None:
    versions = package_versions()
    assert versions["Python"] == f"{sys.version_info.major}.{sys.version_info.minor}"
    assert versions["numpy"] == importlib.import_module("numpy").__version__
    assert {"vtk", "scipy", "python-fcl"} <= set(versions)
