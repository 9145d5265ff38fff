"""From the power map to the list of sources. Sects. 2.4 and 4."""

from __future__ import annotations

from soundmap.config import DetectConfig
from soundmap.detect.peaks import local_maxima
from soundmap.sound import PowerMap, Source, SourceList


def detect_sources(power_map: PowerMap, config: DetectConfig) -> SourceList:
    """Local maxima of the power map where it was visited often enough, loudest first.

    Parameters
    ----------
    power_map : PowerMap
    config : DetectConfig
        ``min_visit_share`` is the 10 % of Sect. 4.

    Returns
    -------
    SourceList
        Empty if nothing was measured.
    """
    power = power_map.power(min_visit_share=config.min_visit_share)
    frame = power_map.frame
    cells = local_maxima(power, radius_cells=config.separation_m / frame.resolution_m)
    places = frame.centres(cells)
    sources = tuple(
        Source(float(x), float(y), float(power[row, column]), int(power_map.visits[row, column]))
        for (x, y), (row, column) in zip(places, cells, strict=True)
    )
    return SourceList(sources, power_map.reference)
