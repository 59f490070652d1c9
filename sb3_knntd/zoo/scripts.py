"""RL Zoo's scripts, run with this package's algorithms and environments known to them."""

from __future__ import annotations

import argparse
import importlib
import runpy
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from sb3_knntd.registry import Role, with_role


class Script(NamedTuple):
    """
    One of RL Zoo's scripts.

    :param module: where it is
    :param function: what runs it; ``None`` if it can only be run as a module
    :param help: what it does
    :param needs: modules it imports that RL Zoo itself can do without
    :param by_folder: whether it looks for runs by the names of their folders
    """

    module: str
    function: str | None
    help: str
    needs: tuple[str, ...] = ()
    by_folder: bool = False


PLOTS = ("seaborn", "rliable")


#: Under the names they have in RL Zoo.
SCRIPTS = {
    "train": Script("rl_zoo3.train", "train", "RL Zoo: train an agent, or search its hyperparameters"),
    "enjoy": Script("rl_zoo3.enjoy", "enjoy", "RL Zoo: watch a trained agent"),
    "record_video": Script("rl_zoo3.record_video", None, "RL Zoo: film a trained agent", ("moviepy",)),
    "plot_train": Script("rl_zoo3.plots", "plot_train", "RL Zoo: plot returns during training", PLOTS, by_folder=True),
    "all_plots": Script("rl_zoo3.plots", "all_plots", "RL Zoo: compare evaluations", PLOTS, by_folder=True),
    "plot_from_file": Script("rl_zoo3.plots", "plot_from_file", "RL Zoo: plot what all_plots has stored", PLOTS),
}


def register() -> None:
    """
    Make this package's own algorithms, their configurations and search spaces, and its environments known to RL Zoo in
    this process.

    :raises ModuleNotFoundError: if RL Zoo is not installed
    """
    # RL Zoo takes seconds to import, and the command line shows its help without it.
    import rl_zoo3.exp_manager
    import rl_zoo3.train
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    import sb3_knntd.envs  # noqa: F401
    from sb3_knntd.zoo.experiment import KNNExperimentManager

    # All of RL Zoo's modules share these tables.
    for name, algorithm in with_role(Role.OWN).items():
        rl_zoo3.ALGOS[name] = algorithm.load()
        search_space = algorithm.load_search_space()
        HYPERPARAMS_SAMPLER[name] = search_space.sample
        HYPERPARAMS_CONVERTER[name] = search_space.convert
    rl_zoo3.train.ExperimentManager = KNNExperimentManager  # type: ignore[attr-defined]


def run(name: str, arguments: Sequence[str]) -> None:
    """
    Run one of RL Zoo's scripts.

    :param name: one of :data:`SCRIPTS`
    :param arguments: its arguments, as on the command line
    :raises KeyError: if there is no such script
    :raises ModuleNotFoundError: if RL Zoo, or what the script needs besides, is not installed
    :raises SystemExit: with code 2 if the arguments do not fit, with 0 after ``--help``
    """
    script = SCRIPTS[name]
    register()
    called_with = sys.argv
    sys.argv = [f"sb3-knntd {name}", *(_folder_names(arguments) if script.by_folder else arguments)]
    try:
        with _errors_in_one_line():
            if script.function is None:
                runpy.run_module(script.module, run_name="__main__")
            else:
                getattr(importlib.import_module(script.module), script.function)()
    finally:
        sys.argv = called_with


@contextmanager
def _errors_in_one_line() -> Iterator[None]:
    """RL Zoo's parsers report mistakes as this package's do, and also those in NAME:VALUE, which they evaluate."""
    from rl_zoo3.utils import StoreDict

    from sb3_knntd.common.command_line import Parser

    report, store = argparse.ArgumentParser.error, StoreDict.__call__

    def store_or_report(action: Any, parser: Any, namespace: Any, values: Sequence[str], *option: Any) -> None:
        try:
            store(action, parser, namespace, values, *option)
        except Exception as error:
            form = "NAME:VALUE, the value as Python has it (gamma:0.9, weights:\"'gaussian'\")"
            raise argparse.ArgumentError(action, f"must be {form}; got {' '.join(values)}: {error}") from error

    argparse.ArgumentParser.error = Parser.error  # type: ignore[assignment,method-assign]
    StoreDict.__call__ = store_or_report  # type: ignore[method-assign]
    try:
        yield
    finally:
        argparse.ArgumentParser.error = report  # type: ignore[method-assign]
        StoreDict.__call__ = store  # type: ignore[method-assign]


def _folder_names(arguments: Sequence[str]) -> list[str]:
    """Environments by the names of their folders, where RL Zoo puts a dash for the slash of an id."""
    from gymnasium import registry
    from huggingface_sb3 import EnvironmentName

    return [EnvironmentName(argument) if argument in registry else argument for argument in arguments]
