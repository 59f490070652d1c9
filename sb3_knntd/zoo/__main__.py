"""Entry point of ``python -m sb3_knntd.zoo train`` and the other commands."""

from __future__ import annotations

import sys

from sb3_knntd.cli import add_zoo, main

if __name__ == "__main__":
    sys.exit(main(prog="python -m sb3_knntd.zoo", commands=(add_zoo,)))
