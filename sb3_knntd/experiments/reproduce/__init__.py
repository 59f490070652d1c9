"""The paper's figures, computed over seeds: one module per figure, and shared helpers."""

from __future__ import annotations

from sb3_knntd.experiments.reproduce.fig3 import FIG3
from sb3_knntd.experiments.reproduce.fig4 import FIG4
from sb3_knntd.experiments.reproduce.fig6 import FIG6
from sb3_knntd.experiments.reproduce.fig7 import FIG7
from sb3_knntd.experiments.reproduce.figure import PaperFigure

#: The figures of ``sb3-knntd reproduce`` by name.
FIGURES: dict[str, PaperFigure] = {figure.name: figure for figure in (FIG3, FIG4, FIG6, FIG7)}

__all__ = ["FIGURES", "PaperFigure"]
