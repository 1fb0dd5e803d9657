"""Where machine code that was made with an installation is found, also where nobody may write to it.

Named in the environment variable ``NUMBA_CACHE_LOCATOR_CLASSES`` of the container; see the Dockerfile.
"""

from __future__ import annotations

from pathlib import Path

from numba.core.caching import InTreeCacheLocator


class ShippedKernels(InTreeCacheLocator):  # type: ignore[misc]
    """The folder beside the source, when it is there: it need not be writable, unlike that of the library."""

    def ensure_cache_path(self) -> None:
        """OSError where there is no such folder, so that the next place is tried."""
        if not Path(self.get_cache_path()).is_dir():
            raise FileNotFoundError(self.get_cache_path())
