import re

import pytest
from handmade import made_ratio, made_run, walled_room

from soundmap.errors import OutputError
from soundmap.outputs.picture_format import PictureFormat
from soundmap.outputs.pictures import (
    difference_pictures,
    drawn,
    run_pictures,
    write_truth_picture,
)

OPENING = {
    PictureFormat.PNG: b"\x89PNG",
    PictureFormat.PDF: b"%PDF",
    PictureFormat.SVG: b"<?xml",
}


def test_a_vector_picture_refers_to_nothing_outside_itself():
    (draw,) = difference_pictures(made_ratio(), room=walled_room(), title="1 against 3").values()
    text = drawn(draw, PictureFormat.SVG).content.decode()
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
