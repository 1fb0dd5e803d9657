"""Show a page on this machine, where that is possible."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path

#: Without any of these a Linux machine has no browser that could show a page; text browsers would take the terminal.
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")


def open_in_browser(page: Path) -> bool:
    """Open a page in the browser of this machine.

    Returns
    -------
    bool
        Whether a browser took it; False on a server, never an error.
    """
    if sys.platform == "linux" and not any(os.environ.get(name) for name in _DISPLAYS):
        return False
    try:
        return webbrowser.open(page.resolve().as_uri())
    except (webbrowser.Error, OSError):
        return False
