"""Where compiled kernels are kept, so that only the first run of all has to wait for them."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path


def kernel_cache_folder(
    package: Path, environment: Mapping[str, str], home: Path | None
) -> Path | None:
    """The folder that numba is to be told of; None if it finds one by itself.

    By itself it keeps kernels beside the code. Where that cannot be written, as in an installation
    for all users, they go to the user's cache folder, and without one to a new folder that only
    this run uses: nobody else may put code there.

    Parameters
    ----------
    package : Path
        Where the code lies.
    environment : mapping
        Variables; ``NUMBA_CACHE_DIR`` is the user's own choice, ``XDG_CACHE_HOME`` the place of
        caches.
    home : Path or None
        The user's home; None if there is none.
    """
    if "NUMBA_CACHE_DIR" in environment or os.access(package, os.W_OK):
        return None
    caches = environment.get("XDG_CACHE_HOME")
    if caches:
        folder = Path(caches) / "soundmap"
    elif home is not None:
        below = Path("Library") / "Caches" if sys.platform == "darwin" else Path(".cache")
        folder = home / below / "soundmap"
    else:
        return Path(tempfile.mkdtemp(prefix="soundmap-"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return Path(tempfile.mkdtemp(prefix="soundmap-"))
    return folder if os.access(folder, os.W_OK) else Path(tempfile.mkdtemp(prefix="soundmap-"))
