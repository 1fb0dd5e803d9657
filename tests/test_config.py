"""Settings: layers, strictness, and messages that say what to mend."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from pipeline import case_declaration, config
from pipeline.config import joints, load_settings, merge, protocols
from pipeline.engine.stage import StrictParams
from pipeline.errors import CaseRejected, ConfigError
from pipeline.flow import FLOW
from pipeline.labels.scheme import without_side
from pipeline.missing_surfaces import MOST_ROTATION_DEG
from tests.toy_flow import TOY_FLOW, IntakeParams, QaParams, write_toy_configs

JOINTS, PROTOCOLS, PRESETS = joints(), protocols(), case_declaration.label_presets()


@pytest.fixture(autouse=True)
def toy_configs(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = write_toy_configs(tmp_path_factory.mktemp("configs"))
    monkeypatch.setattr(config, "CONFIGS", folder)
    monkeypatch.setattr(case_declaration, "LABELS_FOLDER", folder / "labels")
    return folder


@pytest.fixture
def case(tmp_path: Path) -> Path:
    folder = tmp_path / "P001"
    folder.mkdir()
    return folder


def settings(case: Path, overrides: Sequence[str] = (), protocol: str = "clinical") -> dict[str, StrictParams]:
    return load_settings(TOY_FLOW, case, protocol, overrides)


def qa(case: Path, *overrides: str, protocol: str = "clinical") -> QaParams:
    found = settings(case, overrides, protocol)["qa"]
    assert isinstance(found, QaParams)
    return found


def intake(case: Path, *overrides: str) -> IntakeParams:
    found = settings(case, overrides)["intake"]
    assert isinstance(found, IntakeParams)
    return found


def write_protocol(folder: Path, text: str) -> str:
    path = folder / "own.yaml"
    path.write_text(text)
    return str(path)


def test_without_any_file_the_defaults_hold(case: Path) -> None:
    assert qa(case) == QaParams()
    assert intake(case).joint == "knee"
    assert intake(case).side is None


def test_later_layers_win_key_by_key(case: Path) -> None:
    own = write_protocol(case.parent, "qa: {word: protocol, count: 5, grid: {step_deg: 4}}")
    (case / "case.yaml").write_text("settings: {qa: {word: case, grid: {step_deg: 5}}}")
    found = qa(case, "qa.grid.step_deg=6", protocol=own)
    assert (found.count, found.word, found.grid.step_deg, found.grid.range_deg) == (5, "case", 6.0, (0.0, 120.0))


def test_overrides_are_yaml(case: Path) -> None:
    assert qa(case, "qa.grid.range_deg=[0, 90]").grid.range_deg == (0.0, 90.0)
    assert qa(case, "qa.word=no").word == "no"
    assert qa(case, "qa.word=a=b").word == "a=b"
    assert qa(case, "qa.review=true").review is True


def test_the_case_declares_side_and_labels(case: Path) -> None:
    (case / "case.yaml").write_text("side: left\nlabels: {femur: 3, tibia: 4}")
    assert (intake(case).side, intake(case).labels) == ("left", {"femur": 3, "tibia": 4})
    assert intake(case, "intake.labels.femur=9").labels == {"femur": 9, "tibia": 4}


def test_label_presets(case: Path) -> None:
    (case / "case.yaml").write_text("labels: toy")
    assert intake(case).labels == {"femur": 1, "tibia": 2}
    (case / "case.yaml").write_text("labels: toi")
    with pytest.raises(CaseRejected, match=r"E-CASE-05 .*'toi' is not known \(did you mean 'toy'\?\)"):
        settings(case)


def test_the_joint_file_lies_below_the_protocol(case: Path, toy_configs: Path) -> None:
    (toy_configs / "joints" / "elbow.yaml").write_text("qa: {word: elbow, count: 7}")
    (toy_configs / "protocols" / "demo.yaml").write_text("qa: {word: demo}")
    (case / "case.yaml").write_text("joint: elbow")
    assert (qa(case).word, qa(case).count, intake(case).joint) == ("elbow", 7, "elbow")
    assert qa(case, protocol="demo").word == "demo"
    assert intake(case, "intake.joint=knee").joint == "knee"


def test_labels_json_declares_when_there_is_no_case_yaml(case: Path) -> None:
    document = {"labels": {"1": "femoral cartilage", "5": "Femur"}, "side": "right", "dims": [1, 2, 3]}
    (case / "labels.json").write_text(json.dumps(document))
    assert intake(case).labels == {"femoral_cartilage": 1, "femur": 5}
    assert intake(case).side == "right"


def test_declarations_complete_each_other(case: Path) -> None:
    (case / "labels.json").write_text('{"labels": {"5": "femur"}}')
    (case / "case.yaml").write_text("side: left\n")
    assert (intake(case).side, intake(case).labels) == ("left", {"femur": 5})
    (case / "case.yaml").write_text("side: left\nlabels: {femur: 5, tibia: 6}")
    assert intake(case).labels == {"femur": 5, "tibia": 6}


@pytest.mark.parametrize(
    ("yaml", "difference"),
    [
        ("side: left", "side is left in one and right in the other"),
        ("labels: {femur: 6}", "femur is label 6 in one and label 5 in the other"),
        ("labels: {tibia: 5}", "label 5 is tibia in one and femur in the other"),
    ],
)
def test_contradicting_declarations_are_refused(case: Path, yaml: str, difference: str) -> None:
    (case / "labels.json").write_text('{"labels": {"5": "femur"}, "side": "right"}')
    (case / "case.yaml").write_text(yaml)
    with pytest.raises(CaseRejected, match=f"E-CASE-04 case.yaml and labels.json contradict each other: {difference}"):
        settings(case)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("qqa.word=x", r"E-CFG-01 --set qqa.word: 'qqa' is not a stage \(did you mean 'qa'\?\)\."),
        ("qa.wrod=x", r"E-CFG-01 --set qa.wrod: qa.wrod is not a setting \(did you mean 'word'\?\)"),
        ("qa.grid.step_dg=1", r"E-CFG-01 .*qa.grid.step_dg is not a setting \(did you mean 'step_deg'\?\)"),
        ("qa.passes=[{step_dg: 1}]", r"E-CFG-01 .*qa.passes.0.step_dg is not a setting \(did you mean 'step_deg'\?\)"),
        ("qa.grid.step_deg=0", r"E-CFG-02 .*qa.grid.step_deg is 0; it must be greater than 0\."),
        ("qa.grid.step_deg=11", r"E-CFG-02 .*is 11; it must be less than or equal to 10\."),
        ("qa.grid.step_deg=fast", r'E-CFG-02 .*is "fast"; it must be a valid number\.'),
        ("qa.grid.step_deg='2'", r'E-CFG-02 .*is "2"; it must be a valid number\.'),
        ("qa.count=2.5", r"E-CFG-02 .*qa.count is 2.5; it must be a valid integer"),
        ("qa.count=true", r"E-CFG-02 .*qa.count is true; it must be a valid integer"),
        ("qa.review=yes", r'E-CFG-02 .*qa.review is "yes"; it must be a valid boolean'),
        ("intake.side=both", r"E-CFG-02 .*intake.side is \"both\"; it must be 'right' or 'left'\."),
        ("qa.grid.range_deg=[9, 1]", r"E-CFG-02 --set .*: qa.grid: range_deg must not end before it begins\."),
        ("qa=5", r"E-CFG-02 --set qa: qa is 5; expected settings of the stage qa\."),
        ("qa.grid.step_deg", r"E-CFG-05 .*it is not of the form name=value"),
        ("qa..word=x", r"E-CFG-05 "),
        ("=x", r"E-CFG-05 "),
        ("qa.word=.nan", r"E-CFG-05 .*NaN"),
        ("qa.word=a: b", r"E-CFG-05 "),
        ("qa.word=x\nside: left", r"E-CFG-05 "),
        ("intake.joint=kne", r"E-CFG-03 The joint \"kne\" is not known \(did you mean 'knee'\?\)"),
    ],
)
def test_wrong_overrides(case: Path, override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        settings(case, [override])


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        ("sied: left", r"E-CASE-02 case.yaml: 'sied' is not a known key \(did you mean 'side'\?\)"),
        ("side: both", r"E-CASE-03 case.yaml: side is 'both'; expected right or left\."),
        ("side: [right]", r"E-CASE-03 case.yaml: side is \['right'\]; expected right or left\."),
        ("labels: 5", r"E-CASE-03 case.yaml: labels is 5; expected "),
        ("labels: {femur: five}", r"E-CASE-03 case.yaml: labels: femur is 'five'; expected a whole number"),
        ("joint: elbow-of-a-whale", r"E-CASE-06 case.yaml: The joint .* is not known"),
        ("joint: ../../joint", r"E-CASE-06 case.yaml: The joint .* is not known"),
        ("settings: {qa: {count: 100}}", r"E-CASE-03 case.yaml: qa.count is 100; it must be less than or equal to 9"),
        ("settings: {qa: {cuont: 100}}", r"E-CASE-02 case.yaml: qa.cuont is not a setting \(did you mean 'count'\?\)"),
        ("settings: {aq: {}}", r"E-CASE-02 case.yaml: 'aq' is not a stage"),
        (
            "settings: {intake: {side: left}}",
            r"E-CASE-02 case.yaml: settings sets intake.side, which has a key of its own",
        ),
        ("side: left\nside: right", r"E-CASE-01 case.yaml cannot be read: key 'side' is given twice \(line 2\)"),
        ("- a", r"E-CASE-01 case.yaml cannot be read"),
        ("#" + "x" * 100_000, r"E-CASE-01 case.yaml cannot be read: larger than"),
    ],
)
def test_wrong_case_yaml(case: Path, yaml: str, message: str) -> None:
    (case / "case.yaml").write_text(yaml)
    with pytest.raises(CaseRejected, match=message):
        settings(case)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"side": "left", "side": "right"}', r"E-CASE-01 labels.json cannot be read: the name 'side' appears twice"),
        ('{"labels": {"one": "femur"}}', r"E-CASE-03 labels.json: labels: 'one' is 'femur'; expected a label value"),
        ('{"labels": {"1": "femur", "2": "femur"}}', r"E-CASE-03 labels.json: labels: '2' is 'femur'"),
        ('{"labels": {"1": 5}}', r"E-CASE-03 labels.json: labels: '1' is 5"),
        ('{"spacing": NaN}', r"E-CASE-01 labels.json cannot be read: NaN is not a number"),
        ("[]", r"E-CASE-01 labels.json cannot be read: expected names and values"),
        ("{", r"E-CASE-01 labels.json cannot be read: "),
    ],
)
def test_wrong_labels_json(case: Path, text: str, message: str) -> None:
    (case / "labels.json").write_text(text)
    with pytest.raises(CaseRejected, match=message):
        settings(case)


def test_unknown_protocol(case: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"E-CFG-03 .*\"clinicl\" is not known \(did you mean 'clinical'\?\)"
    ) as caught:
        settings(case, protocol="clinicl")
    assert all(name in caught.value.action for name in protocols())


@pytest.mark.parametrize("fact", ["side: left", "joint: knee", "labels: {femur: 1}"])
def test_a_protocol_says_nothing_about_one_case(case: Path, fact: str) -> None:
    own = write_protocol(case.parent, f"intake: {{{fact}}}")
    with pytest.raises(ConfigError, match=r"E-CFG-04 protocol own sets intake\.\w+, which is a fact of one case"):
        settings(case, protocol=own)


def test_a_protocol_that_cannot_be_read(case: Path) -> None:
    own = write_protocol(case.parent, "qa: &a [*a]")
    with pytest.raises(ConfigError, match=r"E-CFG-06 The protocol own cannot be read"):
        settings(case, protocol=own)


def test_no_message_shows_where_the_case_lies(case: Path) -> None:
    (case / "case.yaml").write_text("side: both")
    with pytest.raises(CaseRejected, match=r"E-CASE-03") as caught:
        settings(case)
    assert str(case.parent) not in str(caught.value)


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_what_comes_along_fits_the_flow(case: Path, monkeypatch: pytest.MonkeyPatch, protocol: str, joint: str) -> None:
    monkeypatch.undo()
    (case / "case.yaml").write_text(f"side: left\njoint: {joint}")
    found = load_settings(FLOW, case, protocol)
    assert list(found) == [stage.name for stage in FLOW]
    facts = found["intake"].model_dump()
    assert (facts["joint"], facts["side"]) == (joint, "left")


def test_a_knee_is_swept_from_where_its_surfaces_are_made(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    (case / "case.yaml").write_text("side: left\njoint: knee")
    assert load_settings(FLOW, case, "clinical")["sweep"].model_dump()["rest_rotation_deg"] == MOST_ROTATION_DEG


def test_given_frames_of_a_case_replace_those_of_its_joint(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    rows = [[1.0, 0.0, 0.0, 7.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    (case / "case.yaml").write_text(f"side: right\nframes: {{scan_from_reference: {rows}, scan_from_moving: {rows}}}")
    anatomy = load_settings(FLOW, case, "clinical")["anatomy"].model_dump()
    assert anatomy["method"] == "given"
    assert anatomy["scan_from_reference"] == rows


@pytest.mark.parametrize("labels", PRESETS)
def test_every_label_scheme_names_structures_of_a_knee(
    case: Path, monkeypatch: pytest.MonkeyPatch, labels: str
) -> None:
    monkeypatch.undo()
    (case / "case.yaml").write_text(f"side: left\nlabels: {labels}")
    facts = load_settings(FLOW, case, "clinical")["intake"].model_dump()
    named = {without_side(name)[0] for name in facts["labels"]}
    assert named <= {*facts["required"], *facts["optional"]}
    # one task of TotalSegmentator alone does not find the knee; both are for a command each
    assert set(facts["required"]) <= named or labels.startswith("totalsegmentator_")


SITE = {"command": ["segment", "{ct}", "{labels}"], "labels": {"femur": 1, "tibia": 2}}


@pytest.mark.parametrize("value", [[SITE], [], None, "x"])
def test_a_case_cannot_say_what_the_site_runs(case: Path, monkeypatch: pytest.MonkeyPatch, value: object) -> None:
    monkeypatch.undo()
    (case / "case.yaml").write_text(f"side: left\nsettings: {{segment: {json.dumps({'commands': value})}}}")
    with pytest.raises(CaseRejected, match=r"E-CASE-07 case.yaml sets segment.commands, which only the site may set\."):
        load_settings(FLOW, case, "clinical")
    with pytest.raises(CaseRejected, match=r"E-CASE-07 "):  # nor when the site sets it too
        load_settings(FLOW, case, "clinical", [f"segment.commands={json.dumps([SITE])}"])


def test_the_site_says_what_it_runs(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    (case / "case.yaml").write_text("side: left\nsettings: {segment: {smoothing_mm: 0.5}}")
    own = write_protocol(case.parent, f"segment: {{command_limit_s: 60, commands: {json.dumps([SITE])}}}")
    for found in (
        load_settings(FLOW, case, own)["segment"].model_dump(mode="json"),
        load_settings(FLOW, case, "clinical", [f"segment.commands={json.dumps([SITE])}"])["segment"].model_dump(),
    ):
        (command,) = found["commands"]
        assert (list(command["command"]), command["labels"]) == (SITE["command"], SITE["labels"])
        assert found["smoothing_mm"] == 0.5


class Inner(StrictParams):
    limit_s: float = Field(default=1.0, json_schema_extra={"site_only": True})


class Outer(StrictParams):
    inner: Inner = Inner()


def test_the_mark_holds_inside_nested_settings_as_well(case: Path) -> None:
    flow = (*TOY_FLOW, dataclasses.replace(TOY_FLOW[1], number=85, name="nested", Params=Outer))
    (case / "case.yaml").write_text("settings: {nested: {inner: {limit_s: 2}}}")
    with pytest.raises(CaseRejected, match=r"E-CASE-07 case.yaml sets nested.inner.limit_s, which only the site may"):
        load_settings(flow, case, "clinical")
    (case / "case.yaml").unlink()
    found = load_settings(flow, case, "clinical", ["nested.inner.limit_s=2"])["nested"]
    assert found == Outer(inner=Inner(limit_s=2.0))


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        ({"command": ["s", "{ct}"]}, r"segment.commands.0: the command has no {labels}\."),
        ({"command": ["s", "{labels}"]}, r"segment.commands.0: the command has no {ct}\."),
        (
            {"command": ["s", "{ct}", "{labels}", "{id}"]},
            r"segment.commands.0: {id} stands for nothing; {ct}, {labels}",
        ),
        ({"command": ["{side}/s", "{ct}", "{labels}"]}, r"segment.commands.0: the program itself cannot depend on the"),
        ({"command": "s {ct} {labels}"}, r"segment.commands.0.command is \"s {ct} {labels}\"; it must be a valid"),
        ({"labels": "mskd"}, r"segment.commands.0.labels: the label scheme 'mskd' is not known \(did you mean 'mskt'"),
        ({"labels": {"femur": 0}}, r"segment.commands.0.labels.femur is 0; it must be greater than or equal to 1"),
        ({"labels": {}}, r"segment.commands.0.labels is \{\}; Dictionary should have at least 1 item"),
        ({"version": "/opt/x"}, r"segment.commands.0.version is \"/opt/x\"; String should match"),
        ({"shell": True}, r"segment.commands.0.shell is not a setting"),
    ],
)
def test_wrong_commands(case: Path, monkeypatch: pytest.MonkeyPatch, command: dict[str, object], problem: str) -> None:
    monkeypatch.undo()
    (case / "case.yaml").write_text("side: left")
    own = write_protocol(case.parent, json.dumps({"segment": {"commands": [SITE | command]}}))
    with pytest.raises(ConfigError, match=f"E-CFG-0[12] protocol own: {problem}"):
        load_settings(FLOW, case, own)


def test_a_structure_has_one_command(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    twice = json.dumps([SITE, SITE | {"labels": {"femur_right": 3, "fibula": 4}}])
    with pytest.raises(ConfigError, match=r"E-CFG-02 .*segment.commands: more than one command is to find: femur\."):
        load_settings(FLOW, case, "clinical", [f"segment.commands={twice}"])


def test_there_is_a_knee_and_the_two_protocols() -> None:
    assert "knee" in JOINTS
    assert {"clinical", "demo"} <= set(PROTOCOLS)
    assert {"mskt", "phantom"} <= set(PRESETS)


keys = st.text("abc", min_size=1, max_size=2)
trees = st.recursive(st.integers(), lambda below: st.dictionaries(keys, below, max_size=3), max_leaves=8)
mappings = st.dictionaries(keys, trees, max_size=3)


@given(mappings)
def test_merging_with_nothing_or_itself_changes_nothing(tree: dict[str, object]) -> None:
    assert merge(tree, {}) == merge({}, tree) == merge(tree, tree) == tree


@given(mappings, mappings)
def test_the_later_layer_wins(base: dict[str, object], over: dict[str, object]) -> None:
    merged = merge(base, over)
    assert merged.keys() == base.keys() | over.keys()
    assert merge(merged, over) == merged
    assert all(merged[key] == value for key, value in over.items() if isinstance(value, int))
    assert all(merged[key] == value for key, value in base.items() if key not in over)
