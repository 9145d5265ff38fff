import numpy as np
import pytest
from PIL import Image

from soundmap.errors import MapError
from soundmap.geometry import transformed
from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.map_file import map_files, read_map

YAML = "image: {image}\nresolution: 0.1\norigin: [{x}, {y}, {yaw}]\nnegate: {negate}\n{more}"


def write_map(folder, pixels, *, image="m.pgm", x=-1.0, y=2.0, yaw=0.0, negate=0, more=""):
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(folder / image)
    path = folder / "m.yaml"
    path.write_text(YAML.format(image=image, x=x, y=y, yaw=yaw, negate=negate, more=more))
    return path


ASYMMETRIC = [[254, 254, 0], [254, 205, 254]]  # an obstacle at the top right, unknown below it


def test_first_row_of_the_image_is_the_top_of_the_map(tmp_path):
    room = read_map(write_map(tmp_path, ASYMMETRIC))
    assert room.frame == GridFrame(0.1, (-1.0, 2.0), (2, 3))
    assert room.occupied.tolist() == [[False, False, False], [False, False, True]]
    assert room.free.tolist() == [[True, False, True], [True, True, False]]


@pytest.mark.parametrize("image", ["m.pgm", "m.png", "m.bmp"])
def test_every_image_format_of_map_server_is_read(tmp_path, image):
    room = read_map(write_map(tmp_path, ASYMMETRIC, image=image))
    assert np.count_nonzero(room.occupied) == 1


def test_unknown_stays_unknown_with_the_thresholds_of_nav2(tmp_path):
    path = write_map(tmp_path, ASYMMETRIC, more="occupied_thresh: 0.65\nfree_thresh: 0.25\n")
    assert not read_map(path).free[0, 1]


def test_negated_image_swaps_black_and_white(tmp_path):
    path = write_map(tmp_path, [[255, 0], [0, 0]], negate=1)
    assert read_map(path).occupied.tolist() == [[False, False], [True, False]]


def test_raw_mode_takes_pixels_as_occupancy_in_percent(tmp_path):
    path = write_map(tmp_path, [[100, 0, 255]], more="mode: raw\n")
    room = read_map(path)
    assert room.occupied.tolist() == [[True, False, False]]
    assert room.free.tolist() == [[False, True, False]]


def test_thresholds_of_the_file_are_used(tmp_path):
    path = write_map(tmp_path, [[120, 0]], more="occupied_thresh: 0.5\nfree_thresh: 0.2\n")
    assert read_map(path).occupied.tolist() == [[True, True]]


def test_turned_map_is_laid_along_the_axes(tmp_path):
    pixels = np.full((40, 60), 254)
    pixels[5, 50] = 0  # row 34 from the bottom, column 50
    yaw = 0.7
    room = read_map(write_map(tmp_path, pixels, yaw=yaw))
    expected = transformed([-1.0, 2.0, yaw], [5.05, 3.45])
    found = room.frame.centres(np.argwhere(room.occupied))
    assert np.all(np.hypot(*(found - expected).T) < 0.1)
    assert len(found) >= 1


def test_written_map_is_read_back_the_same(tmp_path):
    rng = np.random.default_rng(1)
    state = rng.integers(0, 3, size=(13, 17))
    frame = GridFrame(0.05, (-3.2, 0.123456789), state.shape)
    room = OccupancyGrid(frame, state == 0, state == 1)
    for name, content in map_files(room).items():
        (tmp_path / name).write_bytes(content)
    back = read_map(tmp_path / "map.yaml")
    assert back.frame == frame
    assert np.array_equal(back.occupied, room.occupied)
    assert np.array_equal(back.free, room.free)


class TestFaults:
    def test_missing_file(self, tmp_path):
        with pytest.raises(MapError, match=r"none.yaml: the map cannot be read"):
            read_map(tmp_path / "none.yaml")

    def test_missing_image(self, tmp_path):
        path = write_map(tmp_path, ASYMMETRIC)
        (tmp_path / "m.pgm").unlink()
        with pytest.raises(MapError, match=r"m.pgm: the image of m.yaml cannot be read"):
            read_map(path)

    def test_binary_file_instead_of_yaml(self, tmp_path):
        (tmp_path / "m.yaml").write_bytes(bytes(range(256)))
        with pytest.raises(MapError, match="Expected a map_server YAML file"):
            read_map(tmp_path / "m.yaml")

    def test_missing_keys_are_named(self, tmp_path):
        (tmp_path / "m.yaml").write_text("image: m.pgm\n")
        with pytest.raises(MapError, match="resolution, origin missing"):
            read_map(tmp_path / "m.yaml")

    def test_impossible_resolution(self, tmp_path):
        path = write_map(tmp_path, ASYMMETRIC)
        path.write_text(path.read_text().replace("0.1", "-1"))
        with pytest.raises(MapError, match="metres a cell"):
            read_map(path)

    def test_text_instead_of_an_image(self, tmp_path):
        path = write_map(tmp_path, ASYMMETRIC)
        (tmp_path / "m.pgm").write_text("hello")
        with pytest.raises(MapError, match="not an image"):
            read_map(path)

    def test_truncated_image(self, tmp_path):
        path = write_map(tmp_path, np.full((50, 50), 254))
        image = tmp_path / "m.pgm"
        image.write_bytes(image.read_bytes()[:200])
        with pytest.raises(MapError, match="cannot be read"):
            read_map(path)

    def test_map_without_walls(self, tmp_path):
        with pytest.raises(MapError, match="no cell of the map is occupied"):
            read_map(write_map(tmp_path, np.full((5, 5), 254)))


def test_a_written_map_reads_as_map_server_does(tmp_path):
    """Rows from the top, 8 bits; occupied above occupied_thresh, free below free_thresh."""
    rng = np.random.default_rng(6)
    kind = rng.integers(0, 3, (5, 7))
    room = OccupancyGrid(GridFrame(0.05, (-1.25, 0.4), (5, 7)), kind == 0, kind == 1)
    for name, content in map_files(room).items():
        (tmp_path / name).write_bytes(content)
    lines = (tmp_path / "map.yaml").read_text().splitlines()
    said = dict(line.split(": ", 1) for line in lines if ": " in line)
    magic, *words = (tmp_path / said["image"]).read_bytes().split(maxsplit=4)
    width, height, most = (int(word) for word in words[:3])
    assert (magic, width, height, most) == (b"P5", 7, 5, 255)
    pixels = np.frombuffer((tmp_path / said["image"]).read_bytes()[-35:], dtype=np.uint8)
    occupancy = (255.0 - pixels.reshape(5, 7)[::-1]) / 255.0
    assert int(said["negate"]) == 0
    assert float(said["resolution"]) == 0.05
    assert [float(word) for word in said["origin"].strip("[]").split(",")] == [-1.25, 0.4, 0.0]
    assert np.array_equal(occupancy > float(said["occupied_thresh"]), room.occupied)
    assert np.array_equal(occupancy < float(said["free_thresh"]), room.free)
