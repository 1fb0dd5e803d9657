"""Settings: YAML and command line to one small frozen object a stage.

Layers, later wins: the defaults beside the code, the joint file, the protocol, the case's own ``case.yaml``, ``--set``.
Only settings that can change a result live here; how many processes compute it is the business of the command line.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from pipeline.case_declaration import CaseDeclaration, read_declaration
from pipeline.engine.stage import Stage, StrictParams
from pipeline.errors import CaseRejected, ConfigError, PipelineError
from pipeline.files.strict_yaml import parse_yaml
from pipeline.suggestions import did_you_mean, listed, shown

CONFIGS = Path(__file__).parent / "configs"
DEFAULT_JOINT = "knee"

#: What only the case itself can say; a protocol is written once for many cases.
CASE_FACTS = ("intake.side", "intake.joint", "intake.labels")


@dataclass(frozen=True)
class Layer:
    """One source of settings.

    Attributes
    ----------
    name : str
        As a message names it, such as ``protocol clinical``.
    fault : "usage" or "case"
        Whose mistake a wrong value is.
    values : dict
        Stage name -> settings of that stage, nested as in YAML.
    """

    name: str
    fault: Literal["usage", "case"]
    values: Mapping[str, object]


def load_settings(
    flow: Sequence[Stage], case_folder: Path, protocol: str, overrides: Sequence[str] = ()
) -> dict[str, StrictParams]:
    """The validated settings of every stage.

    Parameters
    ----------
    flow : sequence of Stage
    case_folder : Path
        Where ``case.yaml`` or ``labels.json`` may lie.
    protocol : str
        Name of a protocol that comes with the program, or path of a YAML file.
    overrides : sequence of str
        ``stage.key=value``.

    Raises
    ------
    ConfigError
        A protocol or an override is wrong.
    CaseRejected
        The case's own declaration is wrong, or sets what only the site may set (E-CASE-07).
    """
    layers = settings_layers(case_folder, protocol, overrides)
    for layer in layers:
        _refuse_unknown_sections(layer, flow)
        if layer.fault == "case":
            _refuse_site_settings(layer, flow)
    merged: dict[str, object] = {}
    for layer in layers:
        merged = merge(merged, layer.values)
    return {stage.name: _validated(stage, merged.get(stage.name, {}), layers) for stage in flow}


def settings_layers(case_folder: Path, protocol: str, overrides: Sequence[str]) -> tuple[Layer, ...]:
    """The layers above the defaults, in the order in which they are applied."""
    chosen = [_override(text) for text in overrides]
    declaration = read_declaration(case_folder)
    joint = _chosen_joint(declaration, chosen)
    return (
        _joint_layer(joint, declaration),
        _protocol_layer(protocol),
        Layer(declaration.file or "case.yaml", "case", _declared_values(declaration)),
        *chosen,
    )


def merge(base: Mapping[str, object], over: Mapping[str, object]) -> dict[str, object]:
    """Two nested mappings as one; where both have a value, the second's wins."""
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        merged[key] = merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def protocols() -> tuple[str, ...]:
    """Names of the protocols that come with the program."""
    return _names("protocols")


def joints() -> tuple[str, ...]:
    """Names of the joints that the program knows."""
    return _names("joints")


def _names(folder: str) -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in (CONFIGS / folder).glob("*.yaml")))


def parse_assignment(text: str) -> tuple[list[str], object]:
    """The dotted name and the value, read as YAML, of ``stage.key=value``.

    Raises
    ------
    ConfigError
        E-CFG-05.
    """
    path, equals, value = text.partition("=")
    keys = path.split(".")
    try:
        if not equals or not all(keys) or "\n" in value:
            raise ValueError("it is not of the form name=value")
        return keys, parse_yaml(f"value: {value}".encode())["value"]
    except ValueError as error:
        problem = f"--set {shown(text)} cannot be understood: {error}."
        raise ConfigError("E-CFG-05", problem, "Write it as --set name=value, without blanks.") from error


def _override(text: str) -> Layer:
    keys, value = parse_assignment(text)
    values: dict[str, object] = {keys[-1]: value}
    for key in reversed(keys[:-1]):
        values = {key: values}
    return Layer(f"--set {'.'.join(keys)}", "usage", values)


def _chosen_joint(declaration: CaseDeclaration, overrides: Sequence[Layer]) -> str:
    joint: object = declaration.joint or DEFAULT_JOINT
    for layer in overrides:
        joint = _at(layer.values, ("intake", "joint"), joint)
    return str(joint)


def _at(values: object, path: Sequence[object], absent: object = None) -> object:
    for key in path:
        if not isinstance(values, Mapping) or key not in values:
            return absent
        values = values[key]
    return values


def _joint_layer(joint: str, declaration: CaseDeclaration) -> Layer:
    if joint not in joints():
        problem = f"The joint {shown(joint)} is not known{did_you_mean(joint, joints())}."
        action = f"Use one of {listed(joints())}."
        raise (
            CaseRejected("E-CASE-06", f"{declaration.file}: {problem}", action)
            if joint == declaration.joint
            else ConfigError("E-CFG-03", problem, action)
        )
    values = _file_values(CONFIGS / "joints" / f"{joint}.yaml", f"joint file {joint}")
    return Layer(f"joint file {joint}", "usage", merge(values, {"intake": {"joint": joint}}))


def _protocol_layer(protocol: str) -> Layer:
    path = CONFIGS / "protocols" / f"{protocol}.yaml" if protocol in protocols() else Path(protocol)
    if path.suffix not in (".yaml", ".yml") or not path.is_file():
        problem = f"The protocol {shown(protocol)} is not known{did_you_mean(protocol, protocols())}."
        raise ConfigError("E-CFG-03", problem, f"Use one of {listed(protocols())}, or the path of a .yaml file.")
    layer = Layer(f"protocol {path.stem}", "usage", _file_values(path, f"protocol {path.stem}"))
    for fact in CASE_FACTS:
        if _at(layer.values, fact.split(".")) is not None:
            problem = f"{layer.name} sets {fact}, which is a fact of one case."
            raise ConfigError("E-CFG-04", problem, "Remove it there and write it into case.yaml in the case folder.")
    return layer


def _file_values(path: Path, name: str) -> dict[str, object]:
    try:
        return parse_yaml(path.read_bytes())
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError("E-CFG-06", f"The {name} cannot be read: {reason}.", f"Correct {path.name}.") from error


def _declared_values(declaration: CaseDeclaration) -> dict[str, object]:
    """The declaration as settings of stages; its ``settings`` section may not restate a declared fact."""
    for fact in CASE_FACTS:
        if _at(declaration.settings, fact.split(".")) is not None:
            key = fact.split(".")[1]
            problem = f"{declaration.file}: settings sets {fact}, which has a key of its own."
            raise CaseRejected("E-CASE-02", problem, f"Write '{key}:' at the top level of {declaration.file} instead.")
    facts = {"side": declaration.side, "labels": declaration.labels}
    intake = {key: value for key, value in facts.items() if value is not None}
    declared: dict[str, object] = {"intake": intake} if intake else {}
    if declaration.frames is not None:
        declared["anatomy"] = {"method": "given", **declaration.frames}
    return merge(declared, declaration.settings)


def _refuse_unknown_sections(layer: Layer, flow: Sequence[Stage]) -> None:
    names = [stage.name for stage in flow]
    for section, values in layer.values.items():
        if section not in names:
            problem = f"{layer.name}: {section!r} is not a stage{did_you_mean(section, names)}."
            raise _fault(layer, "unknown", problem, f"The stages with settings are {listed(names)}.")
        if not isinstance(values, dict):
            problem = f"{layer.name}: {section} is {shown(values)}; expected settings of the stage {section}."
            raise _fault(layer, "value", problem, "Write each setting as name: value, indented below the stage.")


def _refuse_site_settings(layer: Layer, flow: Sequence[Stage]) -> None:
    """Whoever hands in a case must not decide what the site's computer runs: fields marked ``site_only``."""
    for stage in flow:
        for name in _site_settings(stage.Params, layer.values.get(stage.name)):
            problem = f"{layer.name} sets {stage.name}.{name}, which only the site may set."
            raise CaseRejected("E-CASE-07", problem, "Remove it there; who runs the program sets it in the protocol.")


def _site_settings(model: type[BaseModel], values: object) -> Iterator[str]:
    """Dotted names of the settings in nested values that are marked ``site_only``."""
    if not isinstance(values, Mapping):
        return
    for name, described in model.model_fields.items():
        if name not in values:
            continue
        extra, nested = described.json_schema_extra, described.annotation
        if isinstance(extra, dict) and extra.get("site_only"):
            yield name
        elif isinstance(nested, type) and issubclass(nested, BaseModel):
            yield from (f"{name}.{inner}" for inner in _site_settings(nested, values[name]))


def _validated(stage: Stage, values: object, layers: Sequence[Layer]) -> StrictParams:
    """Through JSON, because YAML has lists where settings have tuples, and strict validation of JSON allows that."""
    try:
        return stage.Params.model_validate_json(json.dumps(values))
    except ValidationError as error:
        raise _explained(stage, error.errors()[0], layers) from error


def _explained(stage: Stage, detail: ErrorDetails, layers: Sequence[Layer]) -> PipelineError:
    path = (stage.name, *detail["loc"])
    name = ".".join(str(part) for part in path)
    layer = _layer_that_sets(path, layers)
    if detail["type"] == "extra_forbidden":
        known = sorted(_fields_at(stage.Params, detail["loc"][:-1]))
        problem = f"{layer.name}: {name} is not a setting{did_you_mean(str(path[-1]), known)}."
        return _fault(layer, "unknown", problem, f"The settings there are {listed(known)}.")
    if detail["type"] == "missing":
        return _fault(layer, "value", f"{layer.name}: {name} has no value.", "Give it a value.")
    own_check = detail["type"] == "value_error"  # one of ours, that says itself what it got
    got = ":" if own_check else f" is {shown(detail['input'])};"
    problem = f"{layer.name}: {name}{got} {_expectation(detail['msg'])}."
    return _fault(layer, "value", problem, f"Correct {name} there.")


def _expectation(message: str) -> str:
    """The validator's message as the second half of a sentence."""
    text = message.removeprefix("Value error, ").rstrip(".")
    return text.replace("Input should be", "it must be", 1).replace("Input should", "it must", 1)


def _layer_that_sets(path: Sequence[object], layers: Sequence[Layer]) -> Layer:
    """The last layer that says something at the longest part of a path; a check of several settings has a short one."""
    for length in range(len(path), 0, -1):
        for layer in reversed(layers):
            if _at(layer.values, path[:length]) is not None:
                return layer
    return layers[0]


def _fields_at(model: type[BaseModel], location: Sequence[object]) -> Iterator[str]:
    for part in location:
        if isinstance(part, str):
            model = _nested_model(model.model_fields[part].annotation)
    return iter(model.model_fields)


def _nested_model(annotation: Any) -> type[BaseModel]:
    """The settings class inside an annotation such as ``tuple[Pass, ...]`` or ``Pass | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next(_nested_model(part) for part in get_args(annotation) if part not in (type(None), Ellipsis))


def _fault(layer: Layer, kind: Literal["unknown", "value"], problem: str, action: str) -> PipelineError:
    codes = {"unknown": ("E-CFG-01", "E-CASE-02"), "value": ("E-CFG-02", "E-CASE-03")}
    usage, case = codes[kind]
    return ConfigError(usage, problem, action) if layer.fault == "usage" else CaseRejected(case, problem, action)
