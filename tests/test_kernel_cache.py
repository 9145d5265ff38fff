import os
import subprocess
import sys
from pathlib import Path

import pytest

import soundmap
from soundmap import kernel_cache
from soundmap.kernel_cache import kernel_cache_folder

PACKAGE = Path(soundmap.__file__).parent


@pytest.fixture
def read_only(monkeypatch):
    """Makes folders read-only, which chmod does not for root."""
    closed: set[Path] = set()
    monkeypatch.setattr(kernel_cache.os, "access", lambda path, _: path not in closed)
    return closed


def test_beside_the_code_is_best_and_the_users_own_choice_comes_first(read_only, tmp_path):
    assert kernel_cache_folder(PACKAGE, {}, tmp_path) is None
    read_only.add(PACKAGE)
    assert kernel_cache_folder(PACKAGE, {"NUMBA_CACHE_DIR": "/mine"}, tmp_path) is None


def test_code_that_cannot_be_written_to_is_cached_for_the_user(read_only, tmp_path):
    read_only.add(PACKAGE)
    folder = kernel_cache_folder(PACKAGE, {}, tmp_path)
    assert folder is not None
    assert folder.is_dir()
    assert tmp_path in folder.parents
    elsewhere = {"XDG_CACHE_HOME": str(tmp_path / "caches")}
    assert kernel_cache_folder(PACKAGE, elsewhere, None) == tmp_path / "caches" / "soundmap"


def test_without_any_place_each_run_has_a_folder_of_its_own(read_only, tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache.tempfile, "tempdir", str(tmp_path))
    read_only |= {PACKAGE, tmp_path / ".cache" / "soundmap", tmp_path / "Library/Caches/soundmap"}
    (tmp_path / "file").touch()
    folders = {
        kernel_cache_folder(PACKAGE, {}, None),
        kernel_cache_folder(PACKAGE, {}, tmp_path),
        kernel_cache_folder(PACKAGE, {}, tmp_path / "file"),
    }
    assert len(folders) == 3
    assert all(folder is not None and folder.parent == tmp_path for folder in folders)


def test_kernels_are_compiled_once(tmp_path):
    program = (
        "import numpy as np\n"
        "from soundmap.fuse.surroundings import thinned\n"
        "thinned(np.ones((3, 2)), 8)\n"
        "print(sum(thinned.stats.cache_hits.values()), sum(thinned.stats.cache_misses.values()))"
    )
    told = [
        subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.split()
        for _ in range(2)
    ]
    assert told == [["0", "1"], ["1", "0"]]
