"""The geometric map as a file: map_server's pair of an image and a YAML description.

The image's first row is the top of the map; an `OccupancyGrid`'s first row is the bottom.
"""

from __future__ import annotations

import math
import reprlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soundmap.errors import MapError
from soundmap.geometry import FloatArray, inverted, transformed
from soundmap.grid import GridFrame, OccupancyGrid

FREE_PIXEL, OCCUPIED_PIXEL, UNKNOWN_PIXEL = 254, 0, 205
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
MAX_CELLS = 400_000_000
"""A map of 1 km x 1 km at 5 cm; anything larger is taken for a mistake."""

MAX_ORIGIN_M = 1e7
"""Coordinates of any grid on Earth lie within this."""

_FORMATS = ("PPM", "PNG", "BMP", "TGA", "JPEG", "GIF", "TIFF")
"""Of images that are only ever data: no others are tried, nor the programs that read them."""

_MODES = ("trinary", "scale", "raw")
_THRESHOLDS = {"free_thresh": FREE_THRESHOLD, "occupied_thresh": OCCUPIED_THRESHOLD}

_SHORTENED = reprlib.Repr()
_SHORTENED.maxlevel = 2  # YAML's aliases can multiply without end when they are written out
_short = _SHORTENED.repr


def read_map(path: Path) -> OccupancyGrid:
    """Geometric map from a map_server YAML file and the image that it names.

    Modes trinary, scale and raw are read alike: occupied, free, or else unknown. A map whose
    origin is turned is resampled to axes along those of the map frame.

    Raises
    ------
    MapError
        Says which file, what was found, and what was expected.
    """
    description = _read_description(path)
    image = _read_image(path, description)
    occupied, free = _classified(image, description)
    resolution = float(description["resolution"])
    x, y, yaw = (float(value) for value in description["origin"])
    frame = GridFrame(resolution, (x, y), occupied.shape)
    if abs(yaw) > 1e-9:
        frame, occupied, free = _turned_back(frame, yaw, occupied, free)
    if not occupied.any():
        raise MapError(
            f"{path}: no cell of the map is occupied; the robot cannot be localized in it. "
            "Check occupied_thresh, negate and the image."
        )
    return OccupancyGrid(frame, occupied, free)


def map_files(room: OccupancyGrid, stem: str = "map") -> dict[str, bytes]:
    """The pair of files, by name, that map_server and `read_map` read back as ``room``."""
    pixels = np.full(room.frame.shape, UNKNOWN_PIXEL, dtype=np.uint8)
    pixels[room.free] = FREE_PIXEL
    pixels[room.occupied] = OCCUPIED_PIXEL
    rows, columns = room.frame.shape
    x, y = room.frame.origin_m
    header = f"P5\n{columns} {rows}\n255\n".encode()
    description = (
        f"image: {stem}.pgm\nmode: trinary\nresolution: {room.frame.resolution_m!r}\n"
        f"origin: [{x!r}, {y!r}, 0.0]\nnegate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESHOLD}\nfree_thresh: {FREE_THRESHOLD}\n"
    )
    return {f"{stem}.pgm": header + pixels[::-1].tobytes(), f"{stem}.yaml": description.encode()}


def _read_description(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    expected = "Expected a map_server YAML file with image, resolution and origin."
    try:
        _refuse_what_is_no_file(path)
        found = YAML(typ="safe", pure=True).load(path.read_bytes())
    except OSError as error:
        raise MapError(f"{path}: the map cannot be read ({error.strerror}). {expected}") from None
    except (YAMLError, ValueError, RecursionError):
        raise MapError(f"{path}: not a YAML file. {expected}") from None
    if not isinstance(found, dict):
        raise MapError(f"{path}: no description of a map. {expected}")
    missing = [key for key in ("image", "resolution", "origin") if key not in found]
    if missing:
        raise MapError(f"{path}: {', '.join(missing)} missing. {expected}")
    numbers = found["origin"]
    try:
        x, y, yaw = (float(value) for value in numbers)
        sound = max(abs(x), abs(y)) <= MAX_ORIGIN_M and abs(yaw) <= 2.0 * math.pi
        resolution = float(found["resolution"])
    except (TypeError, ValueError, OverflowError):
        sound, resolution = False, 0.0
    if not sound or isinstance(found["resolution"], bool) or not 1e-3 <= resolution < 10:
        raise MapError(
            f"{path}: resolution {_short(found['resolution'])}, origin {_short(numbers)}; "
            "expected metres a cell, and x, y [m], yaw [rad] of the lower-left corner."
        )
    _check_reading(path, found)
    if not isinstance(found["image"], str):
        raise MapError(f"{path}: image {_short(found['image'])}; expected the name of a file.")
    return found


def _check_reading(path: Path, found: dict[str, Any]) -> None:
    """Refuse settings that do not say which pixels are occupied and which are free."""
    for key in {"occupied_thresh", "free_thresh"} & found.keys():
        if not isinstance(found[key], int | float) or not 0 <= found[key] <= 1:
            raise MapError(f"{path}: {key} {_short(found[key])}; expected a share from 0 to 1.")
    low, high = (float(found.get(key, default)) for key, default in _THRESHOLDS.items())
    if low > high:
        raise MapError(
            f"{path}: free_thresh {low} is above occupied_thresh {high}; pixels would be both."
        )
    if found.get("negate", 0) not in (0, 1):
        raise MapError(f"{path}: negate {_short(found['negate'])}; expected 0 or 1.")
    if found.get("mode", "trinary") not in _MODES:
        raise MapError(f"{path}: mode {_short(found['mode'])}; expected {', '.join(_MODES)}.")


def _refuse_what_is_no_file(path: Path) -> None:
    """A pipe would be waited for without end."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise MapError(f"{path}: not a file.")


def _read_image(path: Path, description: dict[str, Any]) -> NDArray[np.uint8]:
    """Grey values 0..255, first row at the bottom of the map."""
    from PIL import Image, UnidentifiedImageError

    file = path.parent / description["image"]
    try:
        _refuse_what_is_no_file(file)
        with Image.open(file, formats=_FORMATS) as image:
            if image.width * image.height > MAX_CELLS:
                raise MapError(f"{file}: {image.width} x {image.height} cells is too large a map.")
            grey = np.asarray(image.convert("L"))
    except UnidentifiedImageError:
        raise MapError(f"{file}: not an image; expected a PGM, PNG or BMP file.") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise MapError(f"{file}: the image of {path.name} cannot be read: {reason}.") from None
    return np.flipud(grey)


def _classified(
    image: NDArray[np.uint8], description: dict[str, Any]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which cells are occupied and which are free, by map_server's thresholds.

    Savers write 205 for unknown whatever thresholds they state; nav2's free_thresh of 0.25 would
    make it free.
    """
    if description.get("mode") == "raw":
        known = image <= 100
        occupancy = np.where(known, image / 100.0, np.nan)
    else:
        dark = image if description.get("negate") else 255 - image
        occupancy = np.where(image == UNKNOWN_PIXEL, np.nan, dark / 255.0)
    high = float(description.get("occupied_thresh", OCCUPIED_THRESHOLD))
    low = float(description.get("free_thresh", FREE_THRESHOLD))
    return occupancy > high, occupancy < low


def _turned_back(
    frame: GridFrame, yaw: float, occupied: NDArray[np.bool_], free: NDArray[np.bool_]
) -> tuple[GridFrame, NDArray[np.bool_], NDArray[np.bool_]]:
    """The grid that was turned by ``yaw`` about its lower-left corner, with axes along x and y."""
    rows, columns = frame.shape
    step = frame.resolution_m
    turned_origin = np.array([*frame.origin_m, yaw])
    corners: FloatArray = np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]]) * step
    outline = transformed(turned_origin, corners)
    low = np.floor(outline.min(axis=0) / step) * step
    width, height = np.ceil((outline.max(axis=0) - low) / step).astype(int)
    upright = GridFrame(step, (float(low[0]), float(low[1])), (int(height), int(width)))
    centres = upright.centres(np.moveaxis(np.indices(upright.shape), 0, -1))
    inside = GridFrame(step, (0.0, 0.0), frame.shape)
    cells = inside.cells(transformed(inverted(turned_origin), centres))
    within = inside.contains(cells)
    source = np.where(within[..., None], cells, 0)
    row, column = source[..., 0], source[..., 1]
    return upright, within & occupied[row, column], within & free[row, column]
