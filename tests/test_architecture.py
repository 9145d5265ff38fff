"""Data flows one way: log, localize, scan, fuse, detect, outputs; stages share nouns only."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "soundmap"
STAGES = {"logs", "mapping", "localize", "scan", "calibrate", "fuse", "detect"}
COMPOSERS = {
    "replay", "map_log", "retelling", "comparison", "jobs", "cli", "cli_map", "cli_runs",
    "start", "terminal",
}  # fmt: skip
SLOW = {"numba", "scipy", "matplotlib", "rerun", "google"}


def imports(path: Path, *, at_top_only: bool = False) -> set[str]:
    """Full names of the modules that a file imports; not those for type checkers alone."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if at_top_only else list(ast.walk(tree))
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def rooms_of(names: set[str]) -> set[str]:
    return {name.split(".")[1] for name in names if name.startswith("soundmap.")}


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_no_stage_imports_another_stage_or_the_outputs(stage):
    files = list((PACKAGE / stage).glob("*.py"))
    assert len(files) > 2
    for file in files:
        others = rooms_of(imports(file)) & (STAGES | COMPOSERS | {"outputs", "simulate"})
        assert others <= {stage}, file.name


def test_nouns_import_no_stage():
    nouns = {path.stem for path in PACKAGE.glob("*.py")} - COMPOSERS - {"__init__", "evaluate"}
    assert {"geometry", "sensors", "grid", "sound", "config"} <= nouns
    for noun in nouns:
        rooms = rooms_of(imports(PACKAGE / f"{noun}.py"))
        assert not rooms & (STAGES | COMPOSERS | {"outputs", "simulate"}), noun


def test_only_the_recording_imports_rerun():
    users = {
        file.name
        for file in PACKAGE.rglob("*.py")
        if any(name.split(".")[0] == "rerun" for name in imports(file))
    }
    assert users == {"recording.py", "recording_layout.py", "recording_shapes.py"}


def test_the_command_line_loads_nothing_slow_by_itself():
    """What the command line imports when it starts, directly or through its own modules."""
    waiting, seen, slow = ["cli"], set(), set()
    while waiting:
        module = waiting.pop()
        path = PACKAGE.joinpath(*module.split("."))
        file = path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"
        if module in seen or not file.exists():
            continue
        seen.add(module)
        names = imports(file, at_top_only=True)
        slow |= {name for name in names if name.split(".")[0] in SLOW}
        waiting += [name.removeprefix("soundmap.") for name in names if "soundmap." in name]
        waiting += [name.removeprefix("soundmap.") for name in names if name == "soundmap"]
    assert "errors" in seen
    assert slow == set()
