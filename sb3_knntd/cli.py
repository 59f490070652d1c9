"""The command ``sb3-knntd``."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_knntd.common.command_line import run_commands
from sb3_knntd.experiments.compare.parser import add_compare
from sb3_knntd.experiments.demo import add_demo
from sb3_knntd.experiments.reproduce.parser import add_reproduce
from sb3_knntd.export.parser import add_export
from sb3_knntd.insight.command import add_inspect
from sb3_knntd.zoo.parser import add_zoo

#: The commands, in the order of the help.
COMMANDS = (add_demo, add_inspect, add_export, add_reproduce, add_compare, add_zoo)


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: arguments of the command line, without the program's name; by default those of this process
    :return: exit code
    :raises SystemExit: with code 2 if the arguments are invalid, with 0 after ``--help`` and ``--version``
    """
    return run_commands(COMMANDS, argv)
