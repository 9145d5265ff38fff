"""Writers that know nothing of full disks: what they write comes to a file, or is an error."""

import os
from pathlib import Path

import pytest

from soundmap.outputs.piped import OPEN_FILES, piped

pytestmark = pytest.mark.skipif(not OPEN_FILES.is_dir(), reason="no names for pipes here")


def test_all_that_is_written_lies_in_the_file_in_the_end(tmp_path):
    content = os.urandom(5_000_000)
    with piped(tmp_path / "file") as name, Path(name).open("wb") as out:
        out.write(content)
    assert (tmp_path / "file").read_bytes() == content


def written(file, content, ended):
    """Writes all; fails afterwards, but for a disk that is full."""
    with piped(file) as name:
        Path(name).write_bytes(content)
        ended.append(True)
        if file.name != "full":
            raise KeyError


def test_a_writer_to_a_full_disk_does_not_wait_and_hears_of_it_at_the_end():
    ended = []
    with pytest.raises(OSError, match="No space left"):
        written(Path("/dev/full"), bytes(5_000_000), ended)
    assert ended


def test_a_writer_that_fails_leaves_its_own_error(tmp_path):
    with pytest.raises(KeyError):
        written(tmp_path / "file", b"begun", [])
    assert (tmp_path / "file").read_bytes() == b"begun"
