"""Where the lines of a run lie in the map as a whole: every surface passes through its own cells.

The centre of a cell is not where its surface is, and what it errs by is alike for a whole wall: a
map whose walls lie on the edges of their cells, all on the same side, is off by half a cell however
many returns are fitted to it. What a cell does say is that the surface crosses it. All lines of the
run together are moved and turned to where they cross their cells, which the steps of oblique walls
and walls drawn on different sides bound far more closely than a cell is wide. What then still lies
outside its cell is drawn back a little.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from soundmap.geometry import FloatArray
from soundmap.localize.map_fit import Surface
from soundmap.localize.wall_lines import WallLines

SLACK_M = 0.005
"""What lines and maps may err by at a cell's edge ..."""
EDGE_SIGMA_M = 0.004
"""... and how softly a line that errs more is refused."""
STRAY_SHARE = 0.1
"""Cells that no surface crosses, as where a map was drawn roughly."""
INDEPENDENCE = 0.2
"""What a cell counts for: neighbours share returns, and are drawn alike."""
SEARCH_CELLS = (0.8, 0.4, 0.2)
"""Half-widths of the grids of shifts that are tried in turn, about the best so far [cells] ..."""
STEPS = 4
"""... with this many steps each way."""
SOFT_STEPS = 1.6
"""The cells' edges are at least as soft as this many steps of a grid."""
MOST_CELLS = 1000
"""Of the cells of a large map, every so many serve."""
DRAWN_BACK = 0.1
"""Share of the way to its cell that a line outside it is moved, each time that lines are drawn:
where a part of a large site drifts, the moves add up; a cell drawn roughly hardly counts."""


def registered(surface: Surface, lines: WallLines) -> WallLines:
    r"""The lines, moved as one rigid figure to where they cross the cells of the map, or nearly so.

    The shift is the posterior mean, under a flat prior, of a likelihood of every cell c with a
    line: :math:`\Phi((h_c - |e_c|) / \sigma)`, with :math:`e_c` how far its line passes from the
    cell's centre and :math:`h_c` how far the cell reaches along the line's normal, or a stray one.

    Parameters
    ----------
    surface : Surface
    lines : WallLines
        From poses that are right to some centimetres.
    """
    has = np.flatnonzero(np.any(lines.normal != 0.0, axis=1))
    if len(has) == 0:
        return lines
    normal, centre = lines.normal, surface.centre_m - surface.centre_m[has].mean(axis=0)
    size_m = max(1.0, float(np.sqrt(np.mean(np.sum(centre[has] ** 2, axis=1)))))
    turn = (normal[:, 1] * centre[:, 0] - normal[:, 0] * centre[:, 1]) / size_m
    slope = np.column_stack([normal, turn])  # the turn counts as its way at size_m
    off_m = np.sum(normal * surface.centre_m, axis=1) - lines.offset_m
    reach_m = 0.5 * surface.resolution_m * np.abs(normal).sum(axis=1) + SLACK_M
    some = has[:: -(-len(has) // MOST_CELLS)]
    weight = INDEPENDENCE * len(has) / len(some)
    search_m = surface.resolution_m * np.array(SEARCH_CELLS)
    shift = _mean_shift(slope[some], off_m[some], reach_m[some], weight, search_m)
    left_m = off_m - slope @ shift
    outside_m = np.sign(left_m) * np.maximum(np.abs(left_m) - reach_m, 0.0)
    return replace(lines, offset_m=lines.offset_m + slope @ shift + DRAWN_BACK * outside_m)


def _mean_shift(
    slope: FloatArray, off_m: FloatArray, reach_m: FloatArray, weight: float, search_m: FloatArray
) -> FloatArray:
    """Shift in x and y, and turn, [m], shape (3,), by ever finer grids."""
    from scipy.special import log_ndtr

    step = np.arange(-STEPS, STEPS + 1) / STEPS
    grid = np.stack(np.meshgrid(step, step, step, indexing="ij"), axis=-1).reshape(-1, 3)
    table = np.linspace(-40.0, 40.0, 801)
    likelihood = np.logaddexp(np.log1p(-STRAY_SHARE) + log_ndtr(table), np.log(STRAY_SHARE / 3.0))
    shift = np.zeros(3)
    for width_m in search_m:
        sigma_m = max(EDGE_SIGMA_M, SOFT_STEPS * width_m / STEPS)
        tried = shift + width_m * grid
        within = (reach_m - np.abs(off_m - tried @ slope.T)) / sigma_m
        score = weight * np.interp(within, table, likelihood).sum(axis=1)
        share = np.exp(score - score.max())
        shift = share @ tried / share.sum()
    return shift
