"""A disk that fills up: a clear error, and nothing half written, whichever file it stops at."""

import resource
import signal
from contextlib import contextmanager

import pytest
from handmade import made_run

from soundmap.errors import OutputError
from soundmap.outputs.illustrator import Illustrator
from soundmap.outputs.new_folder import new_folder
from soundmap.outputs.progress import chosen_progress
from soundmap.outputs.run_folder import write_run
from soundmap.retelling import recording_of


@contextmanager
def files_no_larger_than(size):
    """As on a full disk, writing beyond this many bytes of a file fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    earlier = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, earlier)


def sizes(folder):
    return sorted({file.stat().st_size for file in folder.iterdir()})


def test_a_disk_that_is_full_at_any_output_leaves_nothing_behind(tmp_path):
    run = made_run()
    with new_folder(tmp_path / "whole", force=False) as folder:
        write_run(run, folder, Illustrator())
    written = sizes(tmp_path / "whole")
    assert len(written) > 8
    for size in written:
        with (
            files_no_larger_than(size - 10),  # digits of the times in a report come and go
            pytest.raises(OutputError, match="cut: cannot be written"),
            new_folder(tmp_path / "cut", force=False) as folder,
        ):
            write_run(run, folder, Illustrator())
        assert [path.name for path in tmp_path.iterdir()] == ["whole"]
    with files_no_larger_than(2 * written[-1]), new_folder(tmp_path / "cut", force=False) as folder:
        write_run(run, folder, Illustrator())
    assert len(list((tmp_path / "cut").iterdir())) == len(list((tmp_path / "whole").iterdir()))


def test_a_recording_that_does_not_fit_on_the_disk_is_an_error_and_leaves_the_run_alone(tmp_path):
    with new_folder(tmp_path / "run", force=False) as folder:
        write_run(made_run(), folder, Illustrator())
    before = sorted(path.name for path in (tmp_path / "run").iterdir())
    with files_no_larger_than(50_000), pytest.raises(OutputError, match="cannot be written"):
        recording_of(tmp_path / "run", progress=chosen_progress(quiet=True))
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == before
