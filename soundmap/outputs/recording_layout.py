"""How a recording opens: which views, where, and from where the map is looked at."""

from __future__ import annotations

import rerun.blueprint as rrb

from soundmap.outputs.area import Area

BACKGROUND = (24, 27, 33, 255)
WHOLE, OVER_TIME = "What was found", "How it went"


def run_layout(area: Area) -> rrb.Blueprint:
    """The run over time with its levels, beside the result with its summary."""
    over_time = _map_view(
        OVER_TIME,
        area,
        ["/world/map", "/world/robot/**", "/world/run/**"],
    )
    found = _map_view(WHOLE, area, ["/world/map", "/world/result/**"])
    level = rrb.TimeSeriesView(origin="/plots/level", name="Level over time [dB]")
    pose = rrb.TimeSeriesView(origin="/plots/pose", name="Quality of the pose")
    summary = rrb.TextDocumentView(origin="/summary", name="Summary")
    return _blueprint(
        rrb.Horizontal(
            rrb.Vertical(found, summary, row_shares=[3, 2]),
            rrb.Vertical(over_time, rrb.Horizontal(level, pose), row_shares=[3, 1]),
            column_shares=[1, 1],
        )
    )


def difference_layout(area: Area) -> rrb.Blueprint:
    """The difference on the map, beside its summary."""
    changed = _map_view("What changed", area, ["/world/map", "/world/result/**"])
    summary = rrb.TextDocumentView(origin="/summary", name="Summary")
    return _blueprint(rrb.Horizontal(changed, summary, column_shares=[2, 1]))


def _map_view(name: str, area: Area, contents: list[str]) -> rrb.Spatial3DView:
    """The floor from above, a little from the south, so that north is up and heights are seen."""
    x, y = (area.left + area.right) / 2.0, (area.bottom + area.top) / 2.0
    far = 0.85 * max(area.width, 1.25 * area.height)
    return rrb.Spatial3DView(
        origin="/world",
        name=name,
        contents=contents,
        background=BACKGROUND,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=[x, y - 0.35 * far, 0.95 * far],
            look_target=[x, y, 0.0],
            eye_up=[0.0, 0.0, 1.0],
        ),
    )


def _blueprint(layout: rrb.Container) -> rrb.Blueprint:
    return rrb.Blueprint(
        layout,
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )
