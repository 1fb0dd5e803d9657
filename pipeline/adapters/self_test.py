"""What ``ct2lut doctor`` tries in a child process: a native library may end the process that asks too much of it.

Each trial does in small what a run does, and answers in one line; the libraries of a run are loaded here only.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping
from typing import Any

from pipeline.errors import PipelineError

#: What :func:`solver` answers where the machine code of some kernel is not there.
NOT_COMPILED = "not compiled"
#: What it answers where machine code could not be kept: a run would end with an error.
NO_PLACE = "no place for machine code"

_RENDERER = re.compile(r"OpenGL renderer string:\s*(\S+)")
#: Greek, an arrow and a sign of comparison, which reports have.
_PAGE = '<html lang="en"><title>Trial</title><p>Text, α β, → ≤</p></html>'


def renderer() -> str:
    """Draw off-screen as the report does; the kind of window, and what draws in it.

    Returns
    -------
    str
        Such as ``vtkEGLRenderWindow, llvmpipe``.

    Raises
    ------
    RuntimeError
        When the frame is blank. A missing renderer ends the process.
    """
    from pipeline.adapters import rendering  # noqa: PLC0415 - numpy, and VTK below: for this trial only

    os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = rendering.RENDER_WINDOW
    rendering.draw_one_frame()
    from vtkmodules import vtkRenderingCore  # noqa: PLC0415 - as above

    window = vtkRenderingCore.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetSize(32, 32)
    window.Render()
    drawn_by = _RENDERER.search(window.ReportCapabilities())
    return ", ".join([window.GetClassName(), *(drawn_by.groups() if drawn_by else ())])


def text() -> str:
    """Set a page as PDF; which libraries that took.

    Raises
    ------
    EnvironmentFault
        ``E-ENV-12`` when a system library or every font is missing.
    """
    from pipeline.adapters.pdf import pdf  # noqa: PLC0415 - WeasyPrint and Pango, for this trial only

    pdf(_PAGE)
    return "Pango, HarfBuzz and a font"


def solver() -> str:
    """Solve a joint of a few triangles, unless a kernel would have to be compiled for it; nothing is compiled.

    Returns
    -------
    str
        ``compiled``, NOT_COMPILED or NO_PLACE.
    """
    _refuse_to_compile()
    try:
        from pipeline.kinematics.direct.warm_up import warm_up  # noqa: PLC0415 - Numba, for this trial only

        warm_up()
    except _Compiling:
        return NOT_COMPILED
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        return NO_PLACE
    return "compiled"


TRIALS: Mapping[str, Callable[[], str]] = {"renderer": renderer, "text": text, "solver": solver}


def answer(trial: str) -> str:
    """One line of JSON: ``found``, or ``problem`` with ``action``; never raises.

    Parameters
    ----------
    trial : str
        One of TRIALS.
    """
    return json.dumps(_answered(TRIALS[trial]))


def _answered(trial: Callable[[], str]) -> dict[str, str]:
    try:
        return {"found": trial()}
    except PipelineError as error:
        return {"problem": error.problem, "action": error.action}
    except ModuleNotFoundError as error:
        return {"problem": f"the Python package {error.name} is missing", "action": "make setup"}
    except Exception as error:  # noqa: BLE001 - whatever a library raises is what the doctor tells; texts name paths
        return {"problem": f"it failed with {type(error).__name__}", "action": ""}


class _Compiling(Exception):
    """A kernel is about to be compiled."""


def _refuse_to_compile() -> None:
    """From here on, whatever Numba would compile raises _Compiling instead."""
    from numba.core import event  # noqa: PLC0415 - for one trial only

    class Refusal(event.Listener):  # type: ignore[misc]
        """Numba tells it before and after it compiles."""

        def on_start(self, _: Any) -> None:
            raise _Compiling

        def on_end(self, _: Any) -> None:
            pass

    event.register("numba:compile", Refusal())
