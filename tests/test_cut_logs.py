"""A log that ends early gives what it would have given had it ended there on purpose."""

import cut_logs
import pytest
import small_logs
import worlds

from soundmap.config import loaded_config
from soundmap.map_file import map_files


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    small_logs.write(folder / "run.mcap")
    for name, content in map_files(worlds.room()).items():
        (folder / name).write_bytes(content)
    (folder / "robot.toml").write_text(small_logs.ARRAY + '[detect]\nmethod = "maxima"\n')
    return folder


@pytest.mark.parametrize("share", [0.02, 0.37, 0.61, 0.94, 0.999])
def test_a_log_cut_anywhere_gives_the_results_of_its_whole_part(site, share):
    log = site / "run.mcap"
    config = loaded_config([site / "robot.toml"])
    found = cut_logs.compared(
        log,
        int(share * log.stat().st_size),
        site / "map.yaml",
        config,
        start_pose=small_logs.START,
    )
    assert found.wrong is None
