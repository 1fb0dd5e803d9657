"""The pictures of the guides: `make pictures`.

    python -m tools.pictures WORK docs/images

Drawings of frames and signs come from the program's own formulas; the rest from phantom knees that are processed
in WORK (kept there: what is up to date is not computed again). Pages are photographed in a headless Chromium; without
one their pictures stay as they are, and that is said.
"""

from __future__ import annotations

import base64
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.adapters.pictures import Image
from pipeline.cli import execute
from pipeline.errors import ExitCode
from tests.players.browser import CHROMIUM, NEXT_FRAME, SOFTWARE_WEBGL, Browser
from tools.frames_drawing import Knee, frames_picture, signs_picture

#: Case -> how the phantom is made, and by which protocol it is processed. The third is declared on the wrong side.
CASES: Mapping[str, tuple[tuple[str, ...], str]] = {
    "P001": (("--ct",), "clinical"),
    "P002": (("--set", "side=left"), "demo"),
    "P003": (("--set", "side=left", "--set", "spacing_mm=[1,1,1]"), "demo"),
    "P004": (("--set", "spacing_mm=[1,1,1]"), "demo"),
}
WRONG_SIDE = "P003"
SHOWN = "P001"
#: Pictures of the report that a guide shows as they are.
COPIED = ("slices", "neutral")
#: Quality of photographed pages; letters stay sharp.
QUALITY = 85


@dataclass(frozen=True)
class Photograph:
    """A part of a page.

    Attributes
    ----------
    name : str
        Of the picture.
    page : str
        Below the results.
    selector : str
        CSS selector of the part; all of the first screen where it is empty.
    size : (width, height)
        Of the window, pixels.
    prepare : str
        JavaScript to run before.
    """

    name: str
    page: str
    selector: str = ""
    size: tuple[int, int] = (1000, 900)
    prepare: str = "0"


#: Bends the knee of the viewer.
_BEND = """(() => {
    const flexion = document.querySelector("#viewer input[name=flexion]");
    flexion.value = 60;
    flexion.dispatchEvent(new Event("input", {bubbles: true}));
    document.querySelector("#viewer button[data-azimuth='90']").click();
    return 0;
})()"""
PHOTOGRAPHS = (
    Photograph("report", f"{SHOWN}/report.html"),
    Photograph("viewer", f"{SHOWN}/report.html", "#viewer canvas", (900, 900), _BEND),
    Photograph("overview", "index.html", size=(1300, 765)),
)


def main(arguments: Sequence[str]) -> int:
    """Write every picture; the exit code."""
    work, out = map(Path, arguments)
    out.mkdir(parents=True, exist_ok=True)
    drawings(out)
    results = processed(work)
    for name in COPIED:
        data = (results / SHOWN / "90_package" / "images" / f"{name}.png").read_bytes()
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        (out / f"{name}.webp").write_bytes(webp(np.asarray(picture, np.uint8)[..., ::-1]))
    if CHROMIUM is None:
        sys.stdout.write("no Chromium: the pictures of pages stay as they are\n")
    else:
        photographs(results, out)
    return ExitCode.PASS


def drawings(out: Path) -> None:
    """Write the drawings of frames and signs."""
    right, left = Knee("right"), Knee("left")
    (out / "frames.webp").write_bytes(webp(frames_picture(right)))
    for knee in (right, left):
        (out / f"signs-{knee.side}.webp").write_bytes(webp(signs_picture(knee)))


def webp(image: Image) -> bytes:
    """WebP bytes of a picture (H, W, 3), RGB.

    Raises
    ------
    RuntimeError
        When the encoder refuses it.
    """
    done, data = cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    if not done:
        raise RuntimeError("the picture cannot be written as WebP")
    return data.tobytes()


def processed(work: Path) -> Path:
    """The folder of results of phantom knees, with their overview.

    Raises
    ------
    RuntimeError
        When a case does not end as it should.
    """
    cases, results = work / "cases", work / "results"
    for name, (options, protocol) in CASES.items():
        if not (cases / name).exists():
            _do("phantom", str(cases), "--id", name, *options)
        if name == WRONG_SIDE:
            declaration = cases / name / "case.yaml"
            declaration.write_text(declaration.read_text().replace("side: left", "side: right"))
        _do("run", name, "--cases", str(cases), "--results", str(results), "--protocol", protocol)
    _do("overview", "--results", str(results))
    return results


def _do(*arguments: str) -> None:
    code = execute(arguments)
    expected = {ExitCode.REJECTED} if arguments[:2] == ("run", WRONG_SIDE) else {ExitCode.PASS, ExitCode.REVIEW}
    if code not in expected:
        raise RuntimeError(f"ct2lut {' '.join(arguments[:2])} ended with {code}")


def photographs(results: Path, out: Path) -> None:
    """Write pictures of pages."""
    for one in PHOTOGRAPHS:
        with _profile() as profile, Browser(Path(profile), *SOFTWARE_WEBGL) as browser:
            browser.call("Emulation.setScrollbarsHidden", hidden=True)
            browser.open((results / one.page).resolve(), one.size)
            browser.run(one.prepare)
            browser.run(NEXT_FRAME)
            options: dict[str, Any] = {"format": "webp", "quality": QUALITY}
            if one.selector:
                box = browser.run(_BOX.format(one.selector))
                options |= {"clip": box | {"scale": 1}, "captureBeyondViewport": True}
            data = browser.call("Page.captureScreenshot", **options)["data"]
        (out / f"{one.name}.webp").write_bytes(base64.b64decode(data))


def _profile() -> tempfile.TemporaryDirectory[str]:
    """A folder of its own for a browser, whose helpers may still write while it is removed."""
    return tempfile.TemporaryDirectory(ignore_cleanup_errors=True)


_BOX = """(() => {{
    const box = document.querySelector("{}").getBoundingClientRect();
    return {{x: box.x + scrollX, y: box.y + scrollY, width: box.width, height: box.height}};
}})()"""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
