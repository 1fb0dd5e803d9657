"""The C# player, compiled and run, against the Python player."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_json import encode_lut_json
from pipeline.kinematics.interpolation import FOUND, Outside
from pipeline.kinematics.table import Grid
from pipeline.playback import Lut
from pipeline.report.figure_viewer import player_data
from tests.files.lut_sample import GRID, content
from tests.players.make_vectors import FILE as VECTORS

CHECKOUT = Path(__file__).resolve().parents[2]
SOURCES = (CHECKOUT / "players" / "csharp" / "Ct2LutPlayer.cs", Path(__file__).with_name("Ct2LutRunner.cs"))
#: Leaves runs of one, two, three and more usable entries along flexion.
BAD = ((3, 1), (4, 1), (2, 2), (4, 2), (12, 3))
POLICIES: tuple[Outside, ...] = ("raise", "clamp", "nan")
ASKED = 200

Float = NDArray[np.float64]
#: Given the text of a table and questions: one line of answer for each.
Ask = Callable[[str, Sequence[str]], list[str]]


@pytest.fixture(scope="module")
def ask(tmp_path_factory: pytest.TempPathFactory) -> Ask:
    """The player compiled, ready to be asked."""
    compiler, runtime = shutil.which("mcs"), shutil.which("mono")
    if compiler is None or runtime is None:
        pytest.skip("mono is not installed (apt-get install mono-mcs mono-runtime)")
    folder = tmp_path_factory.mktemp("csharp")
    program = folder / "player.exe"
    # CS1591 is about comments
    options = ["-langversion:7.2", "-warnaserror", "-nowarn:1591", f"-out:{program}"]
    subprocess.run([compiler, *options, *map(str, SOURCES)], check=True, timeout=120)

    def answers(table: str, questions: Sequence[str]) -> list[str]:
        path = folder / "table.json"
        path.write_text(table, encoding="utf-8")
        run = subprocess.run(
            [runtime, str(program), str(path)],
            input="\n".join(questions),
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        )
        return run.stdout.splitlines()

    return answers


def table_json(table: LutFileContent) -> str:
    """The small JSON that players read."""
    return json.dumps(player_data(table.table))


def attitudes() -> list[tuple[float, float]]:
    """Entries, places between them, on one axis or the other, and outside; some beside entries without a pose."""
    rng = np.random.default_rng(11)
    flexion, varus = rng.uniform(-6.0, 66.0, ASKED), rng.uniform(-5.0, 3.5, ASKED)
    on_flexion, on_varus = np.arange(ASKED) % 4 == 0, np.arange(ASKED) % 3 == 0
    flexion[on_flexion] = rng.choice(GRID.flexion_deg, on_flexion.sum())
    varus[on_varus] = rng.choice(GRID.varus_deg, on_varus.sum())
    return [(float(f), float(v)) for f, v in zip(flexion, varus, strict=True)]


def numbers(line: str) -> Float:
    """The numbers of an answer that is no refusal."""
    return np.array([float(word) for word in line.split()])


def in_words(line: str) -> str:
    """A message without its numbers: the sixth digit of a tie is rounded up by one language and to even by another."""
    return re.sub(r"-?\d+(\.\d+)?", "#", line)


def expected(pose: Callable[[], Float]) -> Float | str:
    """What the Python player answers, flat; its message where it refuses."""
    try:
        return pose().ravel()
    except ValueError as error:
        return str(error)


def test_every_vector_of_the_players_is_met(ask: Ask) -> None:
    held = json.loads(VECTORS.read_text())
    asked = [f"{case['flexion_deg']} {case['varus_deg']!r} {case['outside']}" for case in held["cases"]]
    answers = ask(
        json.dumps(held["data"]), [*(f"pose {one}" for one in asked), *(f"coordinates {one}" for one in asked)]
    )
    for case, pose, used in zip(held["cases"], answers[: len(asked)], answers[len(asked) :], strict=True):
        if case["error"]:
            words = case["error"] if case["outside"] in POLICIES else "outside: expected Raise, Clamp or NaN"
            assert in_words(pose) == in_words(used) == in_words(f"refused {words}")
        else:
            wanted = case["moved_from_scan"] or 16 * [np.nan]
            np.testing.assert_allclose(numbers(pose), wanted, rtol=0, atol=1e-9)
            if case["used"]:
                assert numbers(used)[:2].tolist() == case["used"]


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("policy", POLICIES)
def test_poses_are_those_of_the_python_player(ask: Ask, side: str, policy: Outside) -> None:
    made = content(side, bad=BAD)
    lut, asked = Lut(made), attitudes()
    answers = ask(table_json(made), [f"pose {f!r} {v!r} {policy}" for f, v in asked])
    assert len(answers) == ASKED
    kinds = set()
    for (flexion, varus), line in zip(asked, answers, strict=True):
        wanted = expected(partial(lut.pose, flexion, varus, policy))
        if isinstance(wanted, str):
            assert in_words(line) == in_words(f"refused {wanted}")
            kinds.add("refused")
        else:
            np.testing.assert_allclose(numbers(line), wanted, rtol=0, atol=1e-9)
            kinds.add("nan" if np.isnan(wanted).any() else "pose")
    assert kinds == {"raise": {"pose", "refused"}, "clamp": {"pose"}, "nan": {"pose", "nan"}}[policy]


def test_coordinates_say_what_was_used(ask: Ask) -> None:
    made, asked = content(bad=BAD), attitudes()
    lut = Lut(made)
    answers = ask(table_json(made), [f"coordinates {f!r} {v!r} clamp" for f, v in asked])
    for (flexion, varus), line in zip(asked, answers, strict=True):
        wanted = lut.coordinates(flexion, varus, "clamp")
        np.testing.assert_allclose(numbers(line), wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("flexion", "varus", "policy"),
    [
        (60.125, 0.0, "raise"),
        (10.0, 2.75, "raise"),
        (17.5, -1.0, "raise"),
        (17.5, -0.5, "raise"),
        (float("nan"), 0.0, "clamp"),
    ],
)
def test_refusals_say_the_same(ask: Ask, flexion: float, varus: float, policy: Outside) -> None:
    made = content(bad=BAD)
    (answer,) = ask(table_json(made), [f"pose {flexion!r} {varus!r} {policy}"])
    assert answer == f"refused {expected(partial(Lut(made).pose, flexion, varus, policy))}"


def test_a_table_without_a_pose_has_no_nearest_one(ask: Ask) -> None:
    made = content(bad=tuple((i, j) for i, j in np.ndindex(GRID.shape)))
    assert ask(table_json(made), ["pose 10 0 clamp"]) == ["refused the table has no usable entry"]
    assert ask(table_json(made), ["pose 10 0 nan"]) == [" ".join(16 * ["nan"])]


def test_lut_json_is_read(ask: Ask) -> None:
    made = content("left", bad=BAD)
    lut, asked = Lut(made), attitudes()
    answers = ask(encode_lut_json(made).decode(), [f"pose {f!r} {v!r} clamp" for f, v in asked])
    for (flexion, varus), line in zip(asked, answers, strict=True):
        # lut.json holds ten decimals
        np.testing.assert_allclose(numbers(line), lut.pose(flexion, varus, "clamp").ravel(), rtol=0, atol=1e-6)


def test_of_two_nearest_attitudes_the_first_is_taken(ask: Ask) -> None:
    made = content(grid=Grid(GRID.flexion_deg, np.zeros(1)), bad=((3, 0), (4, 0)))
    (answer,) = ask(table_json(made), ["coordinates 17.5 0 clamp"])
    assert numbers(answer)[0] == Lut(made).coordinates(17.5, 0.0, "clamp").flexion_deg == 10.0


def test_an_entry_of_unknown_status_is_not_usable(ask: Ask) -> None:
    made = content(grid=Grid(GRID.flexion_deg, np.zeros(1)))
    data = json.loads(table_json(made)) | {"status": [[None], [6], *(11 * [[1]])]}
    answers = ask(json.dumps(data), ["pose 0 0 raise", "pose 5 0 raise", "pose 10 0 raise"])
    assert [line.startswith("refused") for line in answers] == [True, True, False]


def rotated(quaternion: Float, point: Float) -> Float:
    """A point turned by a unit quaternion (x, y, z, w)."""
    axis, w = quaternion[:3], quaternion[3]
    twice = 2.0 * np.cross(axis, point)
    return np.asarray(point + w * twice + np.cross(axis, twice))


@pytest.mark.parametrize("side", ["right", "left"])
def test_unity_shows_every_point_where_the_scan_has_it(ask: Ask, side: str) -> None:
    made, rng = content(side), np.random.default_rng(5)
    scanned, flexion = rng.uniform(-500.0, 500.0, (20, 3)), np.linspace(0.0, 60.0, 20)
    motions = Lut(made).pose(flexion, 1.5)
    moved = np.einsum("kij,kj->ki", motions[:, :3, :3], scanned) + motions[:, :3, 3]
    questions = [f"unity {f!r} 1.5 raise" for f in flexion.tolist()]
    questions += [f"point {x!r} {y!r} {z!r}" for x, y, z in [*scanned.tolist(), *moved.tolist()]]
    answers = [numbers(line) for line in ask(table_json(made), questions)]
    for placed, before, after in zip(answers[:20], answers[20:40], answers[40:], strict=True):
        assert np.linalg.norm(placed[3:]) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(rotated(placed[3:], before) + placed[:3], after, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "quaternion"),
    [
        (np.diag([1.0, 1.0, 1.0]), (0.0, 0.0, 0.0, 1.0)),
        (np.diag([1.0, -1.0, -1.0]), (1.0, 0.0, 0.0, 0.0)),
        (np.diag([-1.0, -1.0, 1.0]), (0.0, 1.0, 0.0, 0.0)),
        (np.diag([-1.0, 1.0, -1.0]), (0.0, 0.0, 1.0, 0.0)),
    ],
)
def test_half_turns_have_a_quaternion(ask: Ask, matrix: Float, quaternion: tuple[float, ...]) -> None:
    """A table whose one pose is a half turn; LPS z, up the body, is Unity's y."""
    table = {
        "side": "right",
        "flexion_deg": [0.0],
        "varus_deg": [0.0],
        **{name: [[0.0]] for name in FOUND},
        "status": [[0]],
        "scan_from_reference": [[*row, 0.0] for row in matrix.tolist()] + [[0.0, 0.0, 0.0, 1.0]],
        "scan_from_moving": np.eye(4).tolist(),
    }
    (answer,) = ask(json.dumps(table), ["unity 0 0 raise"])
    np.testing.assert_allclose(np.abs(numbers(answer)), [0.0, 0.0, 0.0, *quaternion], rtol=0, atol=1e-15)


def test_unity_axes_are_right_up_and_forward(ask: Ask) -> None:
    """Of LPS: x to the left, y to the back, z up; metres."""
    answers = ask(table_json(content()), ["point -1000 0 0", "point 0 0 1000", "point 0 -1000 0"])
    np.testing.assert_array_equal([numbers(line) for line in answers], np.eye(3))


def test_other_members_and_escapes_are_read_over(ask: Ask) -> None:
    note = {'note "\\/\u00e9\n': ["\U0001f9b4\t", True, False, None, {}, [], {"a": -1.5e-3}]}
    table = {**note, **json.loads(table_json(content()))}
    for text in (json.dumps(table, indent=2), "\ufeff" + json.dumps(table, ensure_ascii=True)):
        found = numbers(ask(text, ["pose 12.5 0.5 raise"])[0])
        np.testing.assert_allclose(found, Lut(content()).pose(12.5, 0.5).ravel(), rtol=0, atol=1e-9)


def changed(**members: object) -> str:
    return json.dumps({**json.loads(table_json(content())), **members})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not JSON at character 0"),
        (table_json(content())[:-1], "not JSON at character"),
        (table_json(content()) + "x", "not JSON at character"),
        ('{"side": "\\q"}', "not JSON at character 11"),
        (100 * "[" + 100 * "]", "not JSON at character"),
        ("[1]", "expected a JSON object"),
        ("{}", "the table lacks status"),
        (changed(status="all"), "status: expected numbers"),
        (changed(flexion_deg=[]), "flexion: expected strictly increasing degrees"),
        (changed(varus_deg=[0, 1, 1, 2]), "varus: expected strictly increasing degrees"),
        (changed(lateral_mm=[[0.0]]), "a table: expected 52 entries"),
        (changed(scan_from_moving=[1.0]), "a frame: expected 16 numbers"),
    ],
)
def test_what_is_no_table_is_refused(ask: Ask, text: str, message: str) -> None:
    assert ask(text, [])[0].startswith(f"refused {message}")
