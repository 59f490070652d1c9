"""
Train on Mountain-Car for a few seconds, and plot the value and the greedy action of each state.

    python examples/value_function.py value_function.png
"""

import sys
from pathlib import Path

from sb3_knntd import KNNTD
from sb3_knntd.plots import figure_of, plot_value_function


def main() -> None:
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "value_function.png")
    model = KNNTD("MountainCar-v0", seed=0)
    model.learn(50_000)
    value_axes, _ = plot_value_function(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure_of(value_axes).savefig(path)
    print(path)


if __name__ == "__main__":
    main()
