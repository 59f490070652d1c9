"""The installed package: names, files and docstrings."""

from __future__ import annotations

import importlib
import inspect
import pathlib
import pkgutil
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib import metadata, resources
from typing import Any

import pytest

import sb3_knntd

ROOT = pathlib.Path(__file__).parent.parent
# Folders of the root that are installed as subpackages.
MAPPED = {"callbacks": "sb3_knntd/callbacks", "zoo_configs": "sb3_knntd/zoo_configs"}


def test_version() -> None:
    assert sb3_knntd.__version__ == metadata.version("sb3-knntd")
    assert sb3_knntd.__version__[0].isdigit()


def test_names_of_the_contract() -> None:
    assert {"KNNTD", "KNNPolicy", "Perception"} <= set(sb3_knntd.__all__)
    for name in sb3_knntd.__all__:
        assert hasattr(sb3_knntd, name)


def test_typed() -> None:
    assert resources.files("sb3_knntd").joinpath("py.typed").is_file()


@pytest.mark.parametrize("name", ["callbacks", "zoo_configs"])
def test_folders_of_the_root_are_subpackages(name: str) -> None:
    module = importlib.import_module(f"sb3_knntd.{name}")
    assert module.__name__ == f"sb3_knntd.{name}"
    assert module.__doc__


def modules() -> Iterator[Any]:
    yield sb3_knntd
    for found in pkgutil.walk_packages(sb3_knntd.__path__, "sb3_knntd."):
        if not found.name.endswith("__main__"):
            yield importlib.import_module(found.name)


def public_members(cls: type) -> Iterator[tuple[str, Any]]:
    for base in cls.__mro__:
        if base.__module__.startswith("sb3_knntd"):
            for name, member in vars(base).items():
                if not name.startswith("_") and (
                    inspect.isfunction(member) or isinstance(member, (property, classmethod, staticmethod))
                ):
                    yield name, getattr(cls, name)


def test_modules_have_docstrings() -> None:
    silent = [module.__name__ for module in modules() if not module.__doc__]
    assert not silent


def test_public_names_are_documented() -> None:
    silent = []
    for name in sb3_knntd.__all__:
        value = getattr(sb3_knntd, name)
        # A class without a docstring inherits that of its base class.
        if not (vars(value).get("__doc__") if isinstance(value, type) else inspect.getdoc(value)):
            silent.append(name)
        if isinstance(value, type):
            silent += [f"{name}.{member}" for member, function in public_members(value) if not inspect.getdoc(function)]
    assert not silent


def test_parameters_are_documented() -> None:
    documented = "".join(vars(cls).get("__doc__") or "" for cls in sb3_knntd.KNNTD.__mro__[:2])
    parameters = list(inspect.signature(sb3_knntd.KNNTD.__init__).parameters)[1:]
    assert len(parameters) > 20
    assert not [name for name in parameters if f":param {name}:" not in documented]


def test_wheel_holds_everything(tmp_path: pathlib.Path) -> None:
    setuptools = pytest.importorskip("setuptools")
    if int(setuptools.__version__.split(".")[0]) < 77:
        pytest.skip("this setuptools is too old to build the package")
    # Build from a copy, because setuptools creates folders beside the sources.
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("sb3_knntd", *MAPPED):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    subprocess.run(
        [sys.executable, "-c", build, str(tmp_path)], cwd=source, check=True, capture_output=True, timeout=120
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())

    expected = {
        f"{MAPPED.get(folder, folder)}/{file.relative_to(source / folder).as_posix()}"
        for folder in ("sb3_knntd", *MAPPED)
        for file in (source / folder).rglob("*")
        if file.suffix in (".py", ".typed", ".yml") or file.name == "py.typed"
    }
    assert "sb3_knntd/py.typed" in expected
    assert "sb3_knntd/callbacks/__init__.py" in expected
    assert not expected - held
    assert any(name.endswith("LICENSE") for name in held)
    # The folders are installed only inside the package: a top-level `callbacks` would collide with others.
    assert {name.split("/")[0] for name in held if ".dist-info" not in name} == {"sb3_knntd"}


def test_license() -> None:
    assert metadata.metadata("sb3-knntd")["License-Expression"] == "MIT"
