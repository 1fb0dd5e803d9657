"""The rules of ``pipeline/README.md``, read off the source: imports, sizes, the shape of stages."""

from __future__ import annotations

import ast
import re
import statistics
from collections.abc import Iterator

import pytest

from pipeline.engine.artifacts import SOURCE
from pipeline.engine.stage import Stage, StrictParams, findings_of, settings_of
from pipeline.flow import FLOW
from tests.source_code import CHECKOUT, Module, arguments_of, functions, imports, lines_of, modules

MODULES = modules()
IDS = [module.name for module in MODULES]
each_module = pytest.mark.parametrize("module", MODULES, ids=IDS)
each_stage = pytest.mark.parametrize("stage", FLOW, ids=[stage.name for stage in FLOW])

PURE = ("geometry", "kinematics")
#: Compiled libraries that fail silently: wrapped once, where their failures become exceptions.
WRAPPED = {
    "vtk",
    "vtkmodules",
    "fast_simplification",
    "trimesh",
    "fcl",
    "cv2",
    "h5py",
    "meshio",
    "SimpleITK",
    "nibabel",
    "nrrd",
    "pydicom",
    "highdicom",
    "gdcm",
    "jpeg_ls",
    "weasyprint",
}
#: What maths may not see: paths, settings, logs, processes, the wrapped libraries.
IMPURE = WRAPPED | {
    "pathlib",
    "os",
    "io",
    "pydantic",
    "logging",
    "structlog",
    "yaml",
    "subprocess",
    "shutil",
    "tempfile",
}

#: What of ours each of these folders may import.
MAY_IMPORT = {
    "geometry": {*PURE, "records"},
    "kinematics": {*PURE, "records"},
    "engine": {"engine", "errors"},
}


def pipeline_imports(module: Module) -> Iterator[str]:
    """First name below ``pipeline`` of everything of ours that a module imports."""
    return (found.target.split(".")[1] for found in imports(module) if found.target.startswith("pipeline."))


@each_module
def test_pure_folders_see_no_outside_world(module: Module) -> None:
    if module.package in PURE:
        assert not [found for found in imports(module) if found.root in IMPURE]


@each_module
def test_compiled_libraries_are_imported_only_where_they_are_wrapped(module: Module) -> None:
    if module.package not in ("files", "adapters"):
        assert not [found for found in imports(module) if found.root in WRAPPED]


@each_module
def test_folders_import_in_one_direction(module: Module) -> None:
    if module.package in MAY_IMPORT:
        assert set(pipeline_imports(module)) <= MAY_IMPORT[module.package]
    if module.package in ("files", "adapters", "report", "labels", *PURE, "engine"):
        assert not {"stages", "commands"} & set(pipeline_imports(module))
    if module.package == "stages":
        assert not {"commands", "cohort"} & set(pipeline_imports(module))


@each_module
def test_what_supervises_cases_never_loads_what_a_case_loads(module: Module) -> None:
    if module.package == "cohort":
        assert not {"stages", "adapters", *PURE} & set(pipeline_imports(module))
    elif module.package != "cli":
        assert "cohort" not in set(pipeline_imports(module))


@each_module
def test_stages_never_import_one_another(module: Module) -> None:
    if module.package == "stages":
        others = [found for found in imports(module) if found.target.startswith("pipeline.stages")]
        assert not others


@each_module
def test_only_the_command_line_prints_or_exits(module: Module) -> None:
    if module.name == "pipeline.cli" or module.package == "cli":
        return
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in ("print", "sys.exit", "exit", "quit", "os._exit"), (
                f"line {node.lineno}"
            )


@each_module
def test_no_bare_except(module: Module) -> None:
    handlers = [node for node in ast.walk(module.tree) if isinstance(node, ast.ExceptHandler)]
    assert not [handler.lineno for handler in handlers if handler.type is None]


@each_module
def test_pure_folders_raise_only_value_errors(module: Module) -> None:
    if module.package not in PURE:
        return
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Raise) and node.exc is not None:
            raised = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            assert ast.unparse(raised) == "ValueError", f"line {node.lineno}"


@each_module
def test_file_length(module: Module) -> None:
    assert module.text.count("\n") <= 500


@each_module
def test_functions_are_short_and_take_few_arguments(module: Module) -> None:
    for function in functions(module):
        command = any("command" in ast.unparse(decorator) for decorator in function.decorator_list)
        assert lines_of(function) <= 50, function.name
        assert command or arguments_of(function) <= 5, function.name


def test_typical_sizes() -> None:
    lengths = sorted(lines_of(function) for module in MODULES for function in functions(module))
    assert statistics.median(lengths) <= 8
    assert lengths[int(0.9 * len(lengths))] <= 25
    assert statistics.median(module.text.count("\n") for module in MODULES if module.text.strip()) <= 200


@each_module
def test_everything_public_has_a_docstring(module: Module) -> None:
    assert ast.get_docstring(module.tree) or not module.text.strip()
    for name, node in _public(module.tree.body):
        assert ast.get_docstring(node), name


def _public(body: list[ast.stmt]) -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node.name, node
            if isinstance(node, ast.ClassDef):
                yield from _public(node.body)


def test_stages_are_numbered_and_named_once() -> None:
    numbers = [stage.number for stage in FLOW]
    assert numbers == sorted(set(numbers))
    assert len({stage.name for stage in FLOW}) == len(FLOW)


@each_stage
def test_a_stage_lives_in_the_file_of_its_name(stage: Stage) -> None:
    module = __import__(f"pipeline.stages.{stage.name}", fromlist=["STAGE"])
    assert module.STAGE is stage
    assert module.Params is stage.Params


def test_every_stage_file_is_in_the_flow() -> None:
    files = {module.path.stem for module in MODULES if module.package == "stages" and module.path.stem != "__init__"}
    assert files == {stage.name for stage in FLOW}


def test_artifacts_have_one_writer_and_are_read_after_it() -> None:
    written = {SOURCE.name}
    for stage in FLOW:
        assert {artifact.name for artifact in stage.reads} <= written, stage.name
        new = [artifact.name for artifact in (*stage.writes, findings_of(stage.name), settings_of(stage.name))]
        assert not written & set(new), stage.name
        written |= set(new)


#: A unit, or a word for a number that has none.
UNITS = re.compile(
    r"_(mm|mm2|mm3|deg|rad|fraction|ratio|percent|px|n|n_per_mm|per_mm|voxels|hz|hu|s)$"
    r"|count|degree|iterations|size|seed|triangles|width|height|order|number|band|samples|starts|factor|depth|limit|passes|points|cells|clusters"
)


@each_stage
def test_settings_are_strict_ranged_and_described(stage: Stage) -> None:
    assert issubclass(stage.Params, StrictParams)
    for name, described in stage.Params.model_fields.items():
        assert described.description, f"{stage.name}.{name}"
        if described.annotation in (int, float):
            assert described.metadata, f"{stage.name}.{name} has no range"
        if described.annotation is float:
            assert UNITS.search(name), f"{stage.name}.{name} has no unit in its name"


#: Paths of a machine, this checkout's own among them, and loose ends.
FORBIDDEN = re.compile(rf"/home/|/root/|{re.escape(str(CHECKOUT))}/|\bTODO\b|\bFIXME\b|\bXXX\b", re.IGNORECASE)


def test_no_path_of_a_machine_and_no_loose_ends() -> None:
    folders = ("pipeline", "tests", "tools", "docs", ".ci")
    files = [
        path
        for folder in folders
        for path in (CHECKOUT / folder).rglob("*")
        if path.suffix in (".py", ".md", ".yaml", ".sh", ".j2", "")
    ]
    for path in [*files, *(path for path in CHECKOUT.iterdir() if path.suffix in (".md", ".toml", ""))]:
        if path.is_file() and path.name != "test_architecture.py" and not path.name.startswith(".git"):
            assert not FORBIDDEN.search(path.read_text()), path.name
