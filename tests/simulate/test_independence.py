"""The simulator judges the stages, so it may not share their models."""

import ast
from pathlib import Path

import soundmap.simulate

NOUNS = {"soundmap.errors", "soundmap.geometry", "soundmap.grid", "soundmap.map_file"}


def test_the_simulator_shares_nouns_with_the_package_and_no_stage() -> None:
    folder = Path(soundmap.simulate.__file__).parent
    imported: set[str] = set()
    for file in folder.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module)
            elif isinstance(node, ast.Import):
                imported |= {name.name for name in node.names}
    own = {name for name in imported if name.startswith("soundmap")}
    assert {name for name in own if not name.startswith("soundmap.simulate")} == NOUNS
