import importlib
import inspect
import os
import re
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from soundmap.cli import app

TOP = Path(__file__).parents[1]
README = (TOP / "README.md").read_text(encoding="utf-8")
CITED = {"Eq. (1)", "Eq. (2)", "Eq. (3)", "Eq. (4)", "Eq. (5)", "Table 1", "Table 2"}


def index_rows() -> list[tuple[str, str]]:
    """Where in the paper, and the function that does it, for each row of the equation index."""
    table = README.split("| symbol | where | function |\n|---|---|---|\n")[1].split("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    return [(where, function.strip("`")) for _, where, function in rows]


def found(name: str) -> tuple[object, object]:
    """The object of that name inside the package, and its module."""
    parts = name.split(".")
    for count in range(len(parts) - 1, 0, -1):
        try:
            module = importlib.import_module("soundmap." + ".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        thing: object = module
        for part in parts[count:]:
            thing = getattr(thing, part)
        return thing, module
    raise AssertionError(f"no module of {name}")


def citations(text: str) -> set[str]:
    """Equations, tables and sections that a docstring names, one by one."""
    cited = set()
    for first, last in re.findall(r"Eqs?\. \((\d)\)(?:-\((\d)\))?", text):
        cited |= {f"Eq. ({number})" for number in range(int(first), int(last or first) + 1)}
    cited |= {f"Table {number}" for number in re.findall(r"Table (\d)", text)}
    for sections in re.findall(r"Sects?\. ([\d.]+(?:(?:, | and )[\d.]+)*)", text):
        numbers = re.findall(r"\d(?:\.\d)?", sections)
        cited |= {f"Sect. {number}" for number in numbers}
    return cited


@pytest.mark.parametrize(("where", "name"), index_rows())
def test_the_function_of_every_row_exists_and_cites_the_paper(where, name):
    thing, module = found(name)
    text = inspect.getdoc(thing) or ""
    if where.startswith("Sect."):  # the module may say it for all its functions
        text += inspect.getdoc(module) or ""
    assert where in citations(text)


def test_every_equation_and_parameter_table_stands_in_the_index():
    assert {where for where, _ in index_rows()} >= CITED


def test_citations_are_read_one_by_one():
    text = "Eqs. (4)-(5), Sects. 2.4 and 4. Table 1."
    assert citations(text) == {"Eq. (4)", "Eq. (5)", "Sect. 2.4", "Sect. 4", "Table 1"}


def test_the_help_shown_is_what_the_program_prints():
    shown = README.split("$ soundmap process --help\n")[1].split("```")[0]
    printed = CliRunner().invoke(app, ["process", "--help"], env={"COLUMNS": "80"}).stdout
    assert shown.split("Options:")[1].split() == printed.split("Options:")[1].split()


def test_every_exit_code_is_explained():
    from soundmap import errors

    kinds = [kind for kind in vars(errors).values() if inspect.isclass(kind)]
    codes = {str(kind.exit_code) for kind in kinds} | {"0", "130"}
    rows = set(re.findall(r"^\| (\d+) \|", README, flags=re.MULTILINE))
    assert rows == codes


def test_every_file_of_a_run_folder_is_explained(tmp_path):
    from handmade import made_run

    from soundmap.outputs.illustrator import Illustrator
    from soundmap.outputs.run_folder import write_run

    write_run(made_run(), tmp_path, Illustrator())
    missing = [path.name for path in tmp_path.iterdir() if f"`{path.name}`" not in README]
    assert missing == []


def test_the_columns_of_the_tables_are_those_written():
    from soundmap.outputs.report import CHANGE_COLUMNS, SOURCE_COLUMNS

    for columns in (SOURCE_COLUMNS, CHANGE_COLUMNS):
        assert f"`{','.join(columns)}`" in README


def test_the_configuration_shown_is_valid(tmp_path):
    from soundmap.config import loaded_config

    file = tmp_path / "robot.toml"
    file.write_text(re.findall(r"```toml\n(.*?)```", README, flags=re.DOTALL)[0])
    assert loaded_config([file]).array.microphone_positions().shape == (4, 3)


def test_the_commands_shown_are_understood():
    commands = re.findall(r"^soundmap (\w+) (.*?)(?: +#.*)?$", README, flags=re.MULTILINE)
    assert {name for name, _ in commands} >= {"info", "process", "diff", "simulate", "evaluate"}
    for name, arguments in commands:
        text = CliRunner().invoke(app, [name, "--help"]).stdout
        for option in re.findall(r"--[\w-]+", arguments):
            assert f"{option} " in text, (name, option)


def test_the_first_command_processes_a_log_that_is_there():
    command = re.findall(r"\.venv/bin/soundmap process (.*)\n", README)[0]
    files = [word for word in command.split() if not word.startswith("--")]
    assert files
    assert all((TOP / file).is_file() for file in files)


def test_the_pictures_shown_are_there():
    assert all((TOP / file).is_file() for file in re.findall(r'src="([^"]+)"', README))


def test_the_table_of_results_is_the_last_that_was_recorded():
    heading = "| | paper | paper.toml | default |\n"
    recorded = (TOP / "tests" / "benchmarks" / "RESULTS.md").read_text(encoding="utf-8")
    shown, last = (text.split(heading)[1].split("\n\n")[0] for text in (README, recorded))
    assert shown == last


def test_the_checks_that_machines_run_are_those_that_the_readme_names():
    assert "\ntests/run\n" in README
    for script in (TOP / "tests" / "run", TOP / ".ci" / "run"):
        assert os.access(script, os.X_OK)
        subprocess.run(["bash", "-n", script], check=True)
    assert "exec tests/run" in (TOP / ".ci" / "run").read_text()
