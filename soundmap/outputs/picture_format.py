"""The formats that pictures come in; apart from what draws them, which is slow to load."""

from enum import StrEnum


class PictureFormat(StrEnum):
    """What ``--figures`` takes."""

    PNG = "png"
    PDF = "pdf"
    SVG = "svg"
    NONE = "none"
