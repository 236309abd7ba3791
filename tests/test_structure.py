"""The paper is the tree: which file may import which, what is public, and what stays unloaded."""

from __future__ import annotations

import ast
import functools
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

import anchorscan

PACKAGE = Path(anchorscan.__file__).parent
COMMANDS = PACKAGE / "commands"
ROOT = PACKAGE.parents[1]

# In the order of the data flow: a file imports only files that stand before it.  A new file
# gets its place here; one that fits nowhere is a sign that it does two things.
ORDER = (
    *("errors", "progress", "cluster", "pose", "scan", "record", "reference"),
    *("regression", "protocol", "journey"),
    *("array_file", "_jit", "ranking", "covariance"),
    *("angle_function", "segments", "anchors", "graph"),
    *("length_relation", "oriented_relation", "database", "panorama", "spacing", "alignment"),
    *(
        "evidence",
        "tiles",
        "score",
        "field",
        "refinement",
        "rays",
        "proposal",
        "standing",
        "verification",
        "evaluation",
        "hypothesis",
        "decision",
    ),
    *("motion", "belief", "settings"),
    *("description", "pairwise", "placed", "stitched_map", "matcher"),
    *(
        "set_file",
        "set_directory",
        "derived_index",
        "reference_set",
        "set_check",
        "fleet",
        "spread_fleet",
        "window",
    ),
    *("localizer", "topological_localizer"),
    *("scan_message", "client", "shelf", "service_message"),
    *("plausibility", "robot", "robot_parameters", "mailbox"),
    *("explanation", "drawing", "answers"),
    *("sensor", "occupancy", "map_file", "world", "building", "simulator", "exhaustive_search"),
    *("karto_matcher", "monte_carlo", "stage_times", "scoreboard"),
)
VALUES = {"errors", "pose", "scan", "record", "reference"}
# Imported by nobody, but for the command line, which loads them inside its commands.
LEAVES = {
    *(
        "ablation",
        "answer_odds",
        "benchmark",
        "calibration",
        "changed_world",
        "endurance",
        "load",
        "repetition",
        "fleet_benchmark",
        "service",
        "service_benchmark",
        "growth",
        "report",
        "figures",
        "viewer",
        "demo",
        "lost_robot",
        "map_check",
        "sensor_pairs",
        "wrong_data",
        "ros_node",
        "cli",
        "commands",
    ),
    "__main__",
}
SILENT = {"print", "exit", "quit", "breakpoint", "input"}


def modules() -> list[str]:
    return sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__")


@functools.cache
def imports(path: Path, *, only_at_import: bool = False) -> frozenset[tuple[int, str]]:
    """Give (level, first name) of every relative import of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = ast.iter_child_nodes(tree) if only_at_import else ast.walk(tree)
    found: set[tuple[int, str]] = set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.level:
            names = [node.module] if node.module else [alias.name for alias in node.names]
            found |= {(node.level, str(name).split(".")[0]) for name in names}
    return frozenset(found)


def test_every_file_has_a_place() -> None:
    strangers = set(modules()) - set(ORDER) - LEAVES
    assert not strangers, f"say in ORDER or LEAVES where these stand: {sorted(strangers)}"


@pytest.mark.parametrize("module", [name for name in modules() if name in ORDER])
def test_a_file_imports_only_what_stands_before_it(module: str) -> None:
    before = {*ORDER[: ORDER.index(module)]}
    for level, name in imports(PACKAGE / f"{module}.py"):
        assert level == 1
        assert name in before or name == "io", f"{module} must not import {name}"


@pytest.mark.parametrize("module", sorted(LEAVES & {*modules(), "commands"}))
def test_leaves_are_imported_by_nobody_but_the_command_line(module: str) -> None:
    for path in PACKAGE.rglob("*.py"):
        if path.stem in {"cli", "__main__"} or path.parent == COMMANDS:
            continue
        depth = len(path.relative_to(PACKAGE).parts)
        assert (depth, module) not in imports(path), f"{path.stem} imports the leaf {module}"


def test_the_command_line_loads_no_leaf_before_a_command_asks_for_it() -> None:
    at_import = {name for _, name in imports(PACKAGE / "cli.py", only_at_import=True)}
    assert at_import <= {"__version__", "commands"}
    for path in COMMANDS.glob("*.py"):
        loaded = {name for level, name in imports(path, only_at_import=True) if level == 2}
        assert loaded <= {"errors"}, f"commands/{path.name} loads {sorted(loaded)}"


def test_commands_share_what_is_said_read_and_told_and_nothing_else() -> None:
    for path in COMMANDS.glob("*.py"):
        siblings = {name for level, name in imports(path) if level == 1}
        assert siblings <= {"console", "logs", "options"}, f"commands/{path.name}"


def test_readers_import_only_values() -> None:
    for path in (PACKAGE / "io").glob("*.py"):
        outside = {name for level, name in imports(path) if level == 2}
        assert outside <= VALUES, f"io/{path.name} imports {sorted(outside - VALUES)}"


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: path.stem)
def test_the_library_never_prints_exits_or_unpickles(path: Path) -> None:
    if path.stem in LEAVES:
        return
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in SILENT, f"{path.name}:{node.lineno} calls {node.func.id}"
        if isinstance(node, ast.Import):
            assert not {alias.name for alias in node.names} & {"pickle", "marshal", "shelve"}


def test_public_names_are_exact_and_sorted() -> None:
    homes = anchorscan._HOMES
    assert anchorscan.__all__ == sorted([*homes, "__version__"])
    assert list(homes) == sorted(homes)
    assert dir(anchorscan) == anchorscan.__all__
    for name, home in homes.items():
        module = importlib.import_module(f"anchorscan.{home}")
        assert name in module.__all__, f"{name} is not in __all__ of {home}"
        assert getattr(anchorscan, name) is getattr(module, name)


def test_type_checkers_see_the_same_public_names() -> None:
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    seen = {
        alias.asname: str(node.module)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.level == 1
        for alias in node.names
    }
    assert seen == anchorscan._HOMES


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        anchorscan.Nothing  # noqa: B018


@pytest.mark.parametrize("module", [*modules(), "io"])
def test_every_module_says_what_is_public(module: str) -> None:
    if module in {"ros_node", "__main__"}:  # needs ROS; runs the command line
        return
    try:
        loaded = importlib.import_module(f"anchorscan.{module}")
    except anchorscan.MissingExtraError as error:
        pytest.skip(str(error))
    assert list(loaded.__all__) == sorted(loaded.__all__, key=_as_linted)
    for name in loaded.__all__:
        assert hasattr(loaded, name)


def _as_linted(name: str) -> tuple[int, str]:
    """Order as the linter does: constants, classes, the rest."""
    return (0 if name.isupper() else 1 if name[0].isupper() else 2), name


@pytest.mark.parametrize(
    "code",
    [
        "import anchorscan",
        "import anchorscan.cli",
        "import sys; sys.argv = ['anchorscan', '--help']; import anchorscan.cli as c\n"
        "try: c.main()\nexcept SystemExit: pass",
        "import sys; sys.argv = ['anchorscan', 'locate', '--help']; import anchorscan.cli as c\n"
        "try: c.main()\nexcept SystemExit: pass",
    ],
    ids=["import", "import cli", "help", "help of a command"],
)
def test_nothing_heavy_is_loaded_before_it_is_needed(code: str) -> None:
    heavy = ("numba", "matplotlib", "numpy", "scipy", "rosbags", "rtbdata")
    report = f"\nimport sys, json; print(json.dumps([m for m in {heavy!r} if m in sys.modules]))"
    done = subprocess.run(
        [sys.executable, "-c", code + report], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout.splitlines()[-1]) == []


def test_the_changelog_and_the_citation_know_the_version() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"## {anchorscan.__version__}" in changelog or "## Unreleased" in changelog
    assert f"version: {anchorscan.__version__}\n" in citation
