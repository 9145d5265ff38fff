"""The geometric map that a floor plan would have: walls, and furniture that is on the map."""

from __future__ import annotations

import numpy as np

from soundmap.grid import GridFrame, OccupancyGrid
from soundmap.simulate.floor_plan import odd_crossings
from soundmap.simulate.scene import Scene
from soundmap.simulate.scene_file import floor_plan

MARGIN_M = 0.5


def drawn_map(scene: Scene) -> OccupancyGrid:
    """Occupancy grid of a scene's walls; open floor is free, the rest unknown.

    A wall is drawn just behind its surface, where a laser's returns from it end.
    """
    plan = floor_plan(scene)
    cell = scene.room.map_cell_m
    corners = np.concatenate([plan.start_m, plan.end_m])
    low = cell * np.floor((corners.min(axis=0) - MARGIN_M) / cell + 1e-9)
    size = np.ceil((corners.max(axis=0) + MARGIN_M - low) / cell - 1e-9).astype(int)
    frame = GridFrame(cell, (float(low[0].round(9)), float(low[1].round(9))), (size[1], size[0]))
    rows, columns = np.indices(frame.shape)
    centres = frame.centres(np.stack([rows, columns], axis=-1))
    free = plan.contains(centres)
    occupied = np.zeros(frame.shape, dtype=bool)
    for start, end in zip(plan.start_m, plan.end_m, strict=True):
        along = end - start
        normal = np.array([-along[1], along[0]]) / np.hypot(*along)
        middle = 0.5 * (start + end)
        behind = -normal if plan.contains(middle + 1e-3 * normal) else normal
        count = int(np.ceil(np.hypot(*along) / (0.2 * cell))) + 1
        points = start + np.linspace(0.0, 1.0, count)[:, None] * along + 0.02 * cell * behind
        row, column = np.moveaxis(frame.cells(points), -1, 0)
        occupied[row, column] = True
    for thing in scene.furniture:
        if thing.on_map:
            outline = thing.outline()
            occupied |= odd_crossings(centres, outline, np.roll(outline, -1, axis=0))
    return OccupancyGrid(frame, occupied, free & ~occupied)
