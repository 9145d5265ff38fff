import re
import subprocess
import sys
from pathlib import Path

import pytest
from handmade import made_ratio, made_run, walled_room

from soundmap.errors import OutputError
from soundmap.outputs.picture_format import PictureFormat
from soundmap.outputs.pictures import (
    difference_pictures,
    run_pictures,
    write_pictures,
    write_truth_picture,
)

OPENING = {
    PictureFormat.PNG: b"\x89PNG",
    PictureFormat.PDF: b"%PDF",
    PictureFormat.SVG: b"<?xml",
}


def pictures():
    return difference_pictures(made_ratio(), room=walled_room(), title="run1 against run3")


@pytest.mark.parametrize("form", list(OPENING))
def test_a_picture_comes_in_the_format_asked_for_with_equal_bytes_every_time(tmp_path, form):
    contents = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        write_pictures(pictures, tmp_path / name, form)
        (file,) = (tmp_path / name).iterdir()
        assert file.name == f"power_ratio.{form}"
        contents.append(file.read_bytes())
    assert contents[0][:5].startswith(OPENING[form])
    assert contents[0] == contents[1]


def test_without_pictures_nothing_that_draws_is_loaded(tmp_path):
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from pathlib import Path\n"
        "from handmade import made_run\n"
        "from soundmap.outputs.picture_format import PictureFormat\n"
        "from soundmap.outputs.run_folder import write_run\n"
        "write_run(made_run(), Path(sys.argv[2]), figures=PictureFormat.NONE)\n"
        "print([name for name in ('matplotlib', 'PIL', 'rerun') if name in sys.modules])"
    )
    tests = str(Path(__file__).resolve().parents[1])
    command = [sys.executable, "-c", program, tests, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"
    assert (tmp_path / "report.html").is_file()


def test_a_browser_is_given_what_it_can_show(tmp_path):
    for form, expected in ((PictureFormat.PDF, b"\x89PNG"), (PictureFormat.SVG, b"<?xml")):
        (content,) = write_pictures(pictures, tmp_path, form).values()
        assert content.startswith(expected)


def test_without_pictures_nothing_is_drawn_or_written(tmp_path):
    def refused():
        raise AssertionError("drawn")

    assert write_pictures(refused, tmp_path, PictureFormat.NONE) == {}
    assert list(tmp_path.iterdir()) == []


def test_a_vector_picture_refers_to_nothing_outside_itself(tmp_path):
    write_pictures(pictures, tmp_path, PictureFormat.SVG)
    text = (tmp_path / "power_ratio.svg").read_text()
    links = re.findall(r'(?:href|src)="([^"]*)"', text)
    assert links
    assert all(link.startswith(("#", "data:")) for link in links)


def test_a_run_has_its_three_pictures_the_map_of_power_first():
    assert list(run_pictures(made_run())) == ["power_map", "trajectory", "audio_scans"]


@pytest.mark.parametrize("ending", ["png", "PDF", "svg"])
def test_the_truth_is_drawn_in_the_format_of_the_files_name(tmp_path, ending):
    file = tmp_path / f"table2.{ending}"
    write_truth_picture(made_run(), [(3.0, 0.3)], file)
    assert file.read_bytes().startswith(OPENING[PictureFormat(ending.lower())])


def test_a_picture_that_cannot_be_is_refused(tmp_path):
    with pytest.raises(OutputError, match=r"table2\.none: a picture ends in \.png, \.pdf, \.svg"):
        write_truth_picture(made_run(), [], tmp_path / "table2.none")
    with pytest.raises(OutputError, match="cannot be written"):
        write_truth_picture(made_run(), [], tmp_path / "missing" / "table2.png")
