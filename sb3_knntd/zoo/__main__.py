"""Entry point of ``python -m sb3_knntd.zoo train`` and the other commands."""

from __future__ import annotations

import sys

from sb3_knntd.common.command_line import run_commands
from sb3_knntd.zoo.parser import add_zoo

if __name__ == "__main__":
    sys.exit(run_commands((add_zoo,), prog="python -m sb3_knntd.zoo"))
