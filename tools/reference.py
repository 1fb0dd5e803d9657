"""Write the reference pages from the code, so that they cannot say anything else than the program does.

python -m tools.reference docs
"""

from __future__ import annotations

import ast
import itertools
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import typer.main
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from pipeline.cli import EXIT_CODES, app
from pipeline.flow import FLOW
from tests.fault_matrix import ROWS
from tools.fault_table import marked_tests

CODE = re.compile(r"[ENW]-[A-Z]+-\d\d")
BOUNDS = {
    "gt": "above {}",
    "ge": "at least {}",
    "lt": "below {}",
    "le": "at most {}",
    "multiple_of": "a multiple of {}",
}
NOTE = "<!-- written by `make docs` from the code; do not edit -->"


#: Codes whose wording is put together while the program runs.
SUMMARIES = {
    "E-CFG-01": "A stage or setting of that name does not exist (protocol, joint file or `--set`).",
    "E-CFG-02": "A setting has a value that it cannot have (protocol, joint file or `--set`).",
    "E-BAT-02": "No result yet of …, because the machine was at fault: … …",
    "E-GEO-06": "The voxel size of … is outside the range for which results are trusted.",
    "E-BUG-01": "The program failed: … Please report this line and the command you typed.",
    "E-ENV-20": "The operating system refused: … Check the folders you named, their permissions and the disk.",
    "E-USE-01": "The command or one of its options is not known, or something is missing.",
}


FAULTS = """\
A library that reads medical images takes most of what is wrong in silence: of 33 faulty series SimpleITK makes a
volume of 32. This program refuses, warns of or notes each of them but two, which nothing but a list of checksums
(`SHA256SUMS`, as `sha256sum` writes it, in the case folder or in `ct/`) can show; such a list is held against the
files where there is one (`tests/files/test_faulty_series.py`). Foreign files are read in a process of its own,
without network, without other files, with limits of memory and time: one that breaks a decoder costs its own case.

Every row is shown by tests: `make faults` runs them, `make fuzz` mutates files a hundred times as often."""

FLOW_START, FLOW_END = "<!-- flow: written by `make docs` -->", "<!-- end of flow -->"
PIPELINE_README = Path(__file__).parents[1] / "pipeline" / "README.md"


def flow_table() -> str:
    """The flow as a table: every stage, what it does, reads and leaves."""
    rows = [*_table("stage", "does", "reads", "leaves")]
    for stage in FLOW:
        does = _plain((sys.modules[stage.run.__module__].__doc__ or "").split("\n\n")[0]).split(": ", 1)[1]
        reads = [a.name for a in stage.reads if not a.name.endswith(("_findings", "_settings"))]
        for kind in ("findings", "settings"):
            of = [a.name.removesuffix(f"_{kind}") for a in stage.reads if a.name.endswith(f"_{kind}")]
            reads += [f"{kind} of {', '.join(of)}"] if of else []
        leaves = ", ".join(f"`{a.file}`" for a in stage.writes)
        rows.append(_row(f"`{stage.folder}`", does, ", ".join(reads), leaves))
    return "\n".join(rows)


def _with_flow(text: str) -> str:
    start, end = text.index(FLOW_START) + len(FLOW_START), text.index(FLOW_END)
    return f"{text[:start]}\n{flow_table()}\n{text[end:]}"


def pages() -> dict[str, str]:
    """File name -> text of every reference page."""
    return {
        "commands.md": commands_page(),
        "settings.md": settings_page(),
        "messages.md": messages_page(),
        "faults.md": faults_page(),
    }


def commands_page() -> str:
    """Every command of the program with its options."""
    lines = [NOTE, "", "# Commands", "", EXIT_CODES.replace("\n", " "), ""]
    group: Any = typer.main.get_command(app)
    for name, command in group.commands.items():
        lines += [f"## ct2lut {name}", "", _plain(command.help), "", *_table("option", "default", "meaning")]
        lines += [_row(_spelling(option), _default(option), option.help) for option in command.params]
        lines.append("")
    return _page(lines)


def settings_page() -> str:
    """Every setting of every stage with its default, limits and meaning."""
    lines = [NOTE, "", "# Settings", ""]
    lines += ["Written in a protocol or in `settings:` of `case.yaml` as", ""]
    lines += ["    stage:", "      setting: value", "", "or on the command line as `--set stage.setting=value`.", ""]
    for stage in FLOW:
        lines += [
            f"## {stage.name}",
            "",
            *_table("setting", "default", "limits", "meaning"),
            *_settings(stage.Params),
            "",
        ]
    return _page(lines)


def messages_page() -> str:
    """Every code that a message can carry, with its wording; `…` stands for what differs from case to case."""
    wording: dict[str, set[str]] = defaultdict(set)
    for path in sorted((Path(__file__).parents[1] / "pipeline").rglob("*.py")):
        for code, text in _messages(Spelt(path).visit(ast.parse(path.read_text()))):
            wording[code].add(text or SUMMARIES.get(code, ""))
    lines = [NOTE, "", "# Messages", ""]
    lines += [
        "E: stopped. W: look before you use the result. N: a note. `…` stands for what differs from case to case.",
        "",
    ]
    lines += _table("code", "wording")
    lines += [_row(code, "<br>".join(sorted(text for text in wording[code] if text))) for code in sorted(wording)]
    return _page(lines)


def faults_page() -> str:
    """What may be wrong with a case and what then happens, with the number of tests that show it."""
    marked = marked_tests()
    lines = [NOTE, "", "# What may be wrong with a case", "", FAULTS, ""]
    lines += _table("row", "fault", "what happens", "what it cannot see", "tests")
    for name, row in ROWS.items():
        lines.append(_row(name, row.fault, row.outcome, row.limit, len(marked[name])))
    return _page(lines)


def _page(lines: list[str]) -> str:
    return "\n".join(lines).rstrip() + "\n"


def _table(*titles: str) -> list[str]:
    return [_row(*titles), _row(*("---" for _ in titles))]


def _row(*cells: object) -> str:
    return "| " + " | ".join(_plain(str(cell)).replace("|", "\\|") for cell in cells) + " |"


def _plain(text: str | None) -> str:
    return " ".join((text or "").split())


def _spelling(option: Any) -> str:
    names = option.opts if option.param_type_name == "option" else [option.metavar]
    return " ".join(f"`{name}`" for name in names)


def _default(option: Any) -> str:
    return "" if option.required or option.default is None else f"`{option.default}`"


def _settings(model: type[BaseModel], prefix: str = "") -> list[str]:
    rows = []
    for name, described in model.model_fields.items():
        nested = _nested(described.annotation)
        if nested is not None and isinstance(described.annotation, type):
            rows += _settings(nested, f"{prefix}{name}.")
        else:
            rows.append(_row(f"`{prefix}{name}`", _given(described), _limits(described), described.description or ""))
    return rows


def _nested(annotation: Any) -> type[BaseModel] | None:
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _given(described: FieldInfo) -> str:
    default = described.get_default(call_default_factory=True)
    return "required" if default is PydanticUndefined else f"`{default}`"


def _limits(described: FieldInfo) -> str:
    words = [
        words.format(f"{getattr(bound, key):g}")
        for bound in described.metadata
        for key, words in BOUNDS.items()
        if getattr(bound, key, None) is not None
    ]
    choices = [str(choice) for choice in get_args(described.annotation) if isinstance(choice, str)]
    return ", ".join(words or choices)


@dataclass(frozen=True)
class Spelt(ast.NodeTransformer):
    """Puts the values of a module's constants into its texts."""

    path: Path

    def visit_FormattedValue(self, node: ast.FormattedValue) -> ast.expr:
        """``{LIMIT:g}`` becomes its figure."""
        if not (isinstance(node.value, ast.Name) and node.value.id.isupper()):
            return node
        module = import_module(".".join(self.path.relative_to(Path(__file__).parents[1]).with_suffix("").parts))
        return ast.Constant(format(getattr(module, node.value.id), _template(node.format_spec or ast.Constant(""))))


def _messages(tree: ast.Module) -> Iterator[tuple[str, str]]:
    constants = [node for node in tree.body if isinstance(node, ast.Assign)]
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    for scope in (*constants, *functions):
        for call in (node for node in ast.walk(scope) if isinstance(node, ast.Call)):
            yield from _message(call, scope)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and CODE.fullmatch(node.value):
            yield node.value, ""


def _message(call: ast.Call, scope: ast.stmt) -> Iterator[tuple[str, str]]:
    """The texts beside a code in a call; a name stands for each value that it may have there."""
    values = [*call.args, *(keyword.value for keyword in call.keywords)]
    codes = [value.value for value in values if isinstance(value, ast.Constant) and CODE.fullmatch(str(value.value))]
    if not codes:
        return
    choices = [_choices(value, call, scope) if isinstance(value, ast.Name) else [value] for value in values]
    for chosen in itertools.product(*choices):
        texts = [_template(value) for value in chosen]
        yield from ((str(code), " ".join(text for text in texts if " " in text)) for code in codes)


def _choices(name: ast.Name, call: ast.Call, scope: ast.stmt) -> list[ast.expr]:
    """What was last assigned to a name above a call; on each branch, where that is below an ``if`` that ended there."""
    above = [node for node in ast.walk(scope) if isinstance(node, ast.Assign) and node.lineno < call.lineno]
    named = [node for node in above if isinstance(node.targets[0], ast.Name) and node.targets[0].id == name.id]
    if not named:
        return [name]
    last = max(named, key=lambda node: node.lineno)
    ended = [node for node in ast.walk(scope) if isinstance(node, ast.If) and (node.end_lineno or 0) < call.lineno]
    around = [node for node in ended if last in ast.walk(node)]
    branches = list(ast.walk(min(around, key=lambda node: node.lineno))) if around else [last]
    return [node.value for node in named if node in branches]


def _template(value: ast.expr) -> str:
    if isinstance(value, ast.Constant):
        return str(value.value) if isinstance(value.value, str) else ""
    if isinstance(value, ast.JoinedStr):
        return "".join(_template(part) for part in value.values)
    if isinstance(value, ast.BinOp):
        return _template(value.left) + _template(value.right)
    return "…" if isinstance(value, ast.FormattedValue) else ""


def main() -> None:
    """Write the pages into the folder that is given, and the flow into the architecture page."""
    PIPELINE_README.write_text(_with_flow(PIPELINE_README.read_text()))
    for name, text in pages().items():
        (Path(sys.argv[1]) / name).write_text(text)


if __name__ == "__main__":
    main()
