"""What Debian calls the libraries that no wheel brings, in one place; ``tools/setup.sh`` and the image install them."""

from __future__ import annotations

#: The software renderer.
RENDERER = ("libegl1", "libgl1-mesa-dri")
#: What sets text on pages, and a font with Greek letters and arrows.
TEXT = ("libpango-1.0-0", "libpangoft2-1.0-0", "libharfbuzz-subset0", "fonts-dejavu-core")

_INSTALL = "apt-get install -y --no-install-recommends"
#: What whoever looks after the machine has to type, as root.
INSTALL_RENDERER = f"{_INSTALL} {' '.join(RENDERER)}"
INSTALL_TEXT = f"{_INSTALL} {' '.join(TEXT)}"
