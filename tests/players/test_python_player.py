"""The Python player for who does not install the program: one file and numpy, against the program's own playback."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
import venv
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
import pytest

from pipeline import __version__
from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_json import encode_lut_json
from pipeline.kinematics.interpolation import FOUND, Outside
from pipeline.kinematics.table import Grid
from pipeline.playback import Lut
from tests.files.lut_sample import GRID, content
from tests.players.make_vectors import FILE, table

FOLDER = Path(__file__).resolve().parents[2] / "players" / "python"
SOURCE = FOLDER / "ct2lut_player.py"
#: Leaves runs of one, two, three and more usable entries along flexion.
BAD = ((3, 1), (4, 1), (2, 2), (4, 2), (12, 3))
POLICIES: tuple[Outside, ...] = ("raise", "clamp", "nan")
FRAMES = ("scan_from_reference", "scan_from_moving")
Json = dict[str, Any]


@pytest.fixture(scope="module")
def player() -> ModuleType:
    """The one file, as who copies it has it."""
    spec = importlib.util.spec_from_file_location("ct2lut_player", SOURCE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def lut_json(made: LutFileContent) -> Json:
    return cast("Json", json.loads(encode_lut_json(made)))


def exactly(data: Json, flat: Json) -> Json:
    """``lut.json`` with the numbers of the vectors, which are not rounded."""
    return data | {
        "axes": {name: flat[name] for name in ("flexion_deg", "varus_deg")},
        "coordinates": {name: flat[name] for name in FOUND},
        "frames": {name: flat[name] for name in FRAMES},
    }


def test_every_vector_of_the_players_is_met(player: ModuleType) -> None:
    held = json.loads(FILE.read_text())
    lut = player.Lut(exactly(lut_json(table()), held["data"]))
    kinds = []
    for case in held["cases"]:
        at = float(case["flexion_deg"]), case["varus_deg"], case["outside"]
        if case["error"]:
            with pytest.raises(ValueError, match=f"^{re.escape(case['error'])}$"):
                lut.pose(*at)
            with pytest.raises(ValueError, match=f"^{re.escape(case['error'])}$"):
                lut.coordinates(*at)
        else:
            wanted = np.reshape(case["moved_from_scan"] or 16 * [np.nan], (4, 4))
            np.testing.assert_allclose(lut.pose(*at), wanted, rtol=0, atol=1e-9)
            assert case["used"] in (None, [*map(float, lut.coordinates(*at)[:2])])
        kinds.append("refused" if case["error"] else "pose" if case["moved_from_scan"] else "nan")
    assert len(kinds) == 200
    assert min(kinds.count(kind) for kind in ("refused", "pose", "nan")) > 10


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("policy", POLICIES)
def test_one_attitude_and_many_are_those_of_the_program(player: ModuleType, side: str, policy: Outside) -> None:
    made = content(side, bad=BAD)
    lut, program = player.Lut(lut_json(made)), Lut(made)
    rng = np.random.default_rng(11)
    flexion, varus = rng.uniform(-6.0, 66.0, (4, 50)), rng.uniform(-5.0, 3.5, 50)
    if policy == "raise":
        covered = ~np.isnan(program.pose(flexion, varus, "nan")).any(axis=(-2, -1))
        flexion, varus = flexion[covered], np.broadcast_to(varus, flexion.shape)[covered]
    wanted = program.pose(flexion, varus, policy)
    many = lut.pose(flexion, varus, policy)
    assert many.shape == wanted.shape == (*np.broadcast_shapes(flexion.shape, varus.shape), 4, 4)
    # lut.json holds ten decimals
    np.testing.assert_allclose(many, wanted, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        lut.coordinates(flexion, varus, policy), program.coordinates(flexion, varus, policy), rtol=0, atol=1e-6
    )
    one = lut.pose(float(flexion.flat[0]), float(varus.flat[0]), policy)
    np.testing.assert_allclose(one, many.reshape(-1, 4, 4)[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 3)])
def test_the_smallest_grids(player: ModuleType, shape: tuple[int, int]) -> None:
    made = content(grid=Grid(np.arange(float(shape[0])), np.arange(float(shape[1]))))
    lut, at = player.Lut(lut_json(made)), (0.5 * (shape[0] - 1), 0.25 * (shape[1] - 1))
    np.testing.assert_allclose(lut.pose(*at), Lut(made).pose(*at), rtol=0, atol=1e-6)


def test_a_table_says_what_it_is(player: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "lut.json"
    path.write_bytes(b"\xef\xbb\xbf" + encode_lut_json(content("left")))
    lut = player.Lut.read(path)
    assert (lut.joint, lut.side, lut.software) == ("knee", "left", "ct2lut 0.0.0")
    assert (lut.flexion_range, lut.varus_range) == ((0.0, 60.0), (-4.0, 2.5))
    assert lut.coordinates(99.0, 0.0, "clamp")._fields == Lut(content("left")).coordinates(9.0)._fields


def test_a_table_without_a_pose_has_no_nearest_one(player: ModuleType) -> None:
    cells = tuple((i, j) for i, j in np.ndindex(GRID.shape) if (i, j) != (5, 1))
    data = lut_json(content(bad=cells))
    lut = player.Lut(data)
    assert lut.coordinates(99.0, 9.0, "clamp")[:2] == (25.0, -1.0)
    data["status"][5][1] = 2
    with pytest.raises(ValueError, match="the table has no usable entry"):
        player.Lut(data)


def with_member(path: str, value: object) -> Callable[[Json], object]:
    """Puts a value at a place such as ``coordinates.lateral_mm.0.1``; takes the member away for ``...``."""

    def change(data: Any) -> None:
        *way, last = [int(name) if name.isdigit() else name for name in path.split(".")]
        for name in way:
            data = data[name]
        if value is ...:
            del data[last]
        else:
            data[last] = value

    return change


WRONG: dict[str, tuple[Callable[[Json], object], str]] = {
    "other format": (with_member("format", "ct2lut"), "not a table: expected format ct2lut-json, got ct2lut"),
    "no format": (with_member("format", ...), "format is missing"),
    "newer": (with_member("version", "2.0"), r"the table has format version 2\.0, this player reads version 1"),
    "number as text": (with_member("joint", 7), "joint: expected a text"),
    "no axes": (with_member("axes", ...), "axes is missing"),
    "axes as a list": (with_member("axes", []), "axes: expected an object"),
    "no varus": (with_member("axes.varus_deg", ...), "varus_deg is missing"),
    "empty axis": (with_member("axes.varus_deg", []), "varus_deg: expected strictly increasing degrees"),
    "falling axis": (with_member("axes.flexion_deg.3", 0.0), "flexion_deg: expected strictly increasing degrees"),
    "nested axis": (
        with_member("axes.varus_deg", [[1.0]]),
        r"varus_deg: expected a list of numbers, got shape \(1, 1\)",
    ),
    "no curve": (with_member("coordinates.lateral_mm", ...), "lateral_mm is missing"),
    "short row": (
        with_member("coordinates.lateral_mm.0", [1.0]),
        r"lateral_mm: expected shape \(13, 4\) of numbers, got shape \(.*\)",
    ),
    "missing row": (
        with_member("status.12", ...),
        r"status: expected shape \(13, 4\) of numbers, got shape \(12, 4\)",
    ),
    "text as number": (with_member("coordinates.proximal_mm.0.0", "1.0"), "proximal_mm: expected numbers"),
    "truth as number": (with_member("status.0.0", True), "status: expected numbers"),
    "endless number": (with_member("frames.scan_from_moving.0.0", 10**400), "within reach of double precision"),
    "usable null": (with_member("coordinates.lateral_mm.0.0", None), "a usable entry has a coordinate that is not"),
    "side": (with_member("side", "both"), "side: expected right or left, got both"),
    "other side": (with_member("side", "left"), "scan_from_reference: expected a left-handed frame for this side"),
    "skewed frame": (with_member("frames.scan_from_moving.0.0", 2.0), "scan_from_moving: expected a rigid frame"),
    "flat frame": (with_member("frames.scan_from_moving", [[1.0]]), r"scan_from_moving: expected shape \(4, 4\)"),
    "no checks": (with_member("checks", []), "checks: expected a list of check poses"),
    "odd check": (with_member("checks.0", 3), "flexion_deg is missing"),
    "edited curve": (
        lambda data: data["coordinates"]["internal_rotation_deg"].__setitem__(
            slice(None), [[x + 0.01 if x else x for x in row] for row in data["coordinates"]["internal_rotation_deg"]]
        ),
        r"the check pose at flexion \d+ deg, varus .* deg is missed by 0\.0\d+ mm: damaged or changed",
    ),
    "edited frame": (with_member("frames.scan_from_reference.2.3", 641.0), "is missed by 1 mm: damaged or changed"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_table_is_refused(player: ModuleType, tmp_path: Path, name: str) -> None:
    change, sentence = WRONG[name]
    data, path = lut_json(content()), tmp_path / "lut.json"
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=f"^lut.json: .*{sentence}"):
        player.Lut.read(path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (b"", "not JSON: Expecting value"),
        (b"\xff\xfe", "not JSON: 'utf-8' codec"),
        (b"[1]", "not a table: expected a JSON object"),
        (b'{"format": NaN}', "not JSON: NaN is no number of JSON"),
        (b"[" * 100_000, "not JSON: maximum recursion depth"),
    ],
)
def test_what_is_no_json_is_refused(player: ModuleType, tmp_path: Path, text: bytes, sentence: str) -> None:
    path = tmp_path / "other.json"
    path.write_bytes(text)
    with pytest.raises(ValueError, match=f"^other.json: {sentence}"):
        player.Lut.read(path)


def test_the_player_has_the_version_of_the_program(player: ModuleType) -> None:
    assert player.__version__ == __version__


def test_the_file_is_python_3_9() -> None:
    assert ast.parse(SOURCE.read_text(), feature_version=(3, 9))


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a virtual environment with the installed player and numpy, and nothing else; without network."""
    folder = tmp_path_factory.mktemp("player")
    source, place = folder / "source", folder / "venv"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", SOURCE.name):
        (source / name).write_bytes((FOLDER / name).read_bytes())
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-index", "--no-deps"]
    environment = {**os.environ, "PIP_CONFIG_FILE": os.devnull}
    build = [*pip, "wheel", *offline, "--no-build-isolation", "--wheel-dir", str(folder), str(source)]
    subprocess.run(build, check=True, timeout=120, env=environment)
    (wheel,) = folder.glob("ct2lut_player-*.whl")
    venv.create(place, symlinks=True, with_pip=False)
    python = place / "bin" / "python"
    install = [*pip, "--python", str(python), "install", *offline, str(wheel)]
    subprocess.run(install, check=True, timeout=120, env=environment)
    (packages,) = place.glob("lib/python*/site-packages")
    for part in Path(np.__file__).parents[1].glob("numpy*"):
        (packages / part.name).symlink_to(part)
    return python


def ran(python: Path, script: str, folder: Path) -> str:
    command = [str(python), "-I", "-W", "error", "-c", script]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True, timeout=60).stdout


def test_the_installed_player_needs_numpy_alone(installed: Path, tmp_path: Path) -> None:
    made = content("left", bad=BAD)
    (tmp_path / "lut.json").write_bytes(encode_lut_json(made))
    script = (
        "import json, sys, importlib.metadata as metadata\n"
        "before = set(sys.modules)\n"
        "from ct2lut_player import Lut\n"
        "pose = Lut.read('lut.json').pose(12.5, 0.5, 'clamp').tolist()\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names)\n"
        "facts = metadata.metadata('ct2lut-player')\n"
        "print(json.dumps([pose, sorted(new), facts['Version'], facts.get_all('Requires-Dist')]))"
    )
    pose, new, version, needs = json.loads(ran(installed, script, tmp_path))
    np.testing.assert_allclose(pose, Lut(made).pose(12.5, 0.5, "clamp"), rtol=0, atol=1e-6)
    assert set(new) == {"ct2lut_player", "numpy"}
    assert version == __version__
    assert [need.partition(">")[0] for need in needs] == ["numpy"]


def test_the_example_of_the_readme_runs(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "lut.json").write_bytes(encode_lut_json(content()))
    (example,) = re.findall(r"```python\n(.*?)```", (FOLDER / "README.md").read_text(), re.DOTALL)
    shown = ran(installed, example + "print(clip.shape, point.shape)\n", tmp_path)
    rotation = Lut(content()).coordinates(60.0).internal_rotation_deg
    assert shown == f"right knee, 60 deg: {rotation:.1f} deg of internal rotation\n(61, 4, 4) (4,)\n"
