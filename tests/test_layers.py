"""Which part of the package may import which: imports go down the layers, and never in a circle."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import sb3_knntd

PACKAGE = Path(sb3_knntd.__file__).parent
#: From the bottom up. Parts of one line do not import each other.
LAYERS = (
    ("common",),
    ("kernels", "envs", "registry", "distributed", "online_algorithm"),
    ("perception", "q_table"),
    ("actions", "model"),
    ("learners", "filters", "export"),
    ("editing", "datasets"),
    ("policies", "saving"),
    ("offline", "dyna_policies"),
    ("plots",),
    ("insight",),
    ("base",),
    ("planning",),
    ("knntd", "exa", "dyna"),
    ("callbacks", "zoo"),
    ("experiments",),
    ("cli",),
)
HEIGHT = {part: height for height, layer in enumerate(LAYERS) for part in layer}


def modules() -> dict[str, Path]:
    """All modules by name, those of ``callbacks/`` and ``zoo_configs/`` as they are installed."""
    root = PACKAGE.parent
    paths = [*PACKAGE.rglob("*.py"), *(root / "callbacks").glob("*.py"), *(root / "zoo_configs").glob("*.py")]
    found = {}
    for path in paths:
        parts = path.relative_to(root).with_suffix("").parts
        parts = parts if parts[0] == "sb3_knntd" else ("sb3_knntd", *parts)
        found[".".join(parts).removesuffix(".__init__")] = path
    return found


MODULES = modules()


def imported(name: str) -> set[str]:
    """The modules of this package that a module imports, wherever in it."""
    path = MODULES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            # A name is a module, or something in the module before it.
            found |= {full if (full := f"{module}.{alias.name}") in MODULES else module for alias in node.names}
    return {module for module in found if module in MODULES}


def part_of(module: str) -> str:
    """The folder or module directly below ``sb3_knntd``."""
    return module.split(".")[1]


def test_every_part_has_a_layer() -> None:
    assert {part_of(module) for module in MODULES if "." in module} - {"zoo_configs"} == set(HEIGHT)


#: The root gathers the public names, and what is run by ``python -m`` is imported by nobody.
PROGRAMS = {name for name in MODULES if name.endswith(".__main__")}


@pytest.mark.parametrize("module", sorted(set(MODULES) - PROGRAMS - {"sb3_knntd"}))
def test_imports_go_down(module: str) -> None:
    for other in imported(module):
        assert other != "sb3_knntd", f"{module} imports the whole package: name the module that has what it needs"
        if part_of(other) != part_of(module):
            assert HEIGHT[part_of(other)] < HEIGHT[part_of(module)], f"{module} imports {other}, which is above it"


@pytest.mark.parametrize("part", ["kernels", "perception", "q_table", "actions", "learners"])
def test_the_core_does_not_import_sb3(part: str) -> None:
    for module, path in MODULES.items():
        if module.startswith(f"sb3_knntd.{part}") and module not in PROGRAMS:
            assert "stable_baselines3" not in path.read_text(encoding="utf-8"), module


def test_no_imports_in_a_circle() -> None:
    try:
        TopologicalSorter({module: imported(module) for module in MODULES}).prepare()
    except CycleError as error:
        pytest.fail(f"imports in a circle: {' <- '.join(error.args[1])}")


def test_the_layout_in_contributing_names_every_part() -> None:
    """A reader finds every part there, and none that is gone."""
    text = (PACKAGE.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    tree = text.partition("```text\nsb3_knntd/\n")[2].partition("```")[0]
    named = {line.split()[0].removesuffix("/").removesuffix(".py") for line in tree.splitlines() if line[:2] == "  "}
    assert named == {*HEIGHT, "zoo_configs"}


COMMANDS = "compare", "demo", "export", "inspect", "reproduce"


@pytest.mark.parametrize("arguments", [["--help"], *([name, "--help"] for name in COMMANDS)])
def test_help_does_not_wait_for_what_only_the_commands_need(arguments: list[str]) -> None:
    slow = ("rl_zoo3", "optuna", "matplotlib", "plotly", "rliable", "pandas", "ray", "onnx", "safetensors")
    program = f"""
import sys
from sb3_knntd.cli import main
try:
    main({arguments!r})
except SystemExit as end:
    assert end.code == 0
print([name for name in {slow!r} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.splitlines()[-1] == "[]"
