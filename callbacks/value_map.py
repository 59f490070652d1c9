"""Plots of the learned values during training."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from stable_baselines3.common.logger import Image

from sb3_knntd.common.checks import check_flag, check_integer, check_path
from sb3_knntd.common.files import replacing
from sb3_knntd.plots import (
    FINEST,
    Names,
    caption_of,
    check_dims,
    check_fixed,
    check_names,
    count_panels,
    names_for,
    new_figure,
    plot_routes,
    plot_value_function,
    plot_visits,
    value_grid,
)

from .throttled import ThrottledCallback, picture_formats, write
from .visitation import Visitation, last_observation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Dots per inch. A higher resolution takes longer to draw, and TensorBoard does not show it.
DPI = 100
#: Number of panels in a row; further action dimensions are drawn in more rows.
COLUMNS = 3


class ValueMapCallback(ThrottledCallback):
    """
    Draws, over two dimensions of the observations: the value V(s) = max_a Q(s, a) with the trajectories of the last
    episodes of the first environment, the greedy action, and the number of visits of each cell by all environments
    since the first training with this callback. It draws every ``draw_freq`` calls and at the end of training.

    The pictures are written to TensorBoard's images under ``map/value`` if the model logs there, and to ``folder`` if
    given.

    .. code-block:: python

        model = KNNTD("MountainCar-v0", tensorboard_log="logs")
        model.learn(50_000, callback=ValueMapCallback(draw_freq=10_000))

    :param dims: the two dimensions, horizontal and vertical
    :param fixed: values of other dimensions, observation units (with VecNormalize, normalised)
    :param average: whether to average over the dimensions not in ``fixed``, see :func:`~sb3_knntd.plots.value_grid`; by
        default they are fixed in the middle of their range
    :param draw_freq: draw every ``draw_freq`` calls (of n_envs steps each); ``None``: as often as takes 0.1 % of the
        time, a few times per hour
    :param n_routes: number of trajectories, of the last episodes
    :param resolution: number of cells in each of the two dimensions, up to 4096
    :param folder: folder for ``value_map_{steps}.png``; ``None`` for no files
    :param names: names of the dimensions and actions; by default those of known environments, otherwise numbers
    :param verbose: 1 to print a line for each written file
    :raises ValueError: if an argument is invalid; when training begins, if the observations are not a Box of two or
        more dimensions, ``dims``, ``fixed`` or ``names`` do not fit them, or there is neither TensorBoard nor a folder
    :raises ImportError: when training begins, if matplotlib is not installed
    """

    FIRST_SECONDS: ClassVar[float] = 0.4

    def __init__(
        self,
        dims: tuple[int, int] = (0, 1),
        fixed: Mapping[int, float] | None = None,
        average: bool = False,
        draw_freq: int | None = None,
        n_routes: int = 3,
        resolution: int = 60,
        folder: str | Path | None = None,
        names: Names | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__("draw_freq", draw_freq, verbose)
        self.dims = check_dims(dims)
        self.fixed = check_fixed(fixed)
        self.average = check_flag("average", average)
        self.n_routes = check_integer("n_routes", n_routes, 0)
        self.resolution = check_integer("resolution", resolution, 1, FINEST)
        self.folder = None if folder is None else check_path("folder", folder)
        self.names = check_names(names)
        self._visitation = Visitation(self.dims, self.resolution, self.n_routes)

    def _init_callback(self) -> None:
        # Invalid arguments and a missing matplotlib must raise before training, not after hours of it.
        value_grid(self.model, self.dims, self.fixed, 1, self.average)
        names_for(self.model, self.names)
        new_figure(1.0, 1.0)
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)

    def _on_training_start(self) -> None:
        if self.folder is None and not picture_formats(self.logger):
            raise ValueError(
                "ValueMapCallback: the pictures have nowhere to go. Give the model tensorboard_log, or the callback "
                "folder='pictures'"
            )
        assert isinstance(self.model._last_obs, np.ndarray)
        self._visitation.start(self.model._last_obs)
        super()._on_training_start()

    def recorder(self) -> Callable[[np.ndarray], object]:
        """
        :return: a function to call with the observations of every step
        """
        return self._visitation.recent.append

    def _on_step(self) -> bool:
        local = self.locals
        if local["dones"][0]:
            self._visitation.end_trajectory(last_observation(local["infos"], local["new_obs"]))
        if self._visitation.free <= 0:
            self._visitation.count(self._extent())
        return super()._on_step()

    def _next_due(self) -> int:
        return min(super()._next_due(), self.n_calls + self._visitation.free)

    def _on_training_end(self) -> None:
        super()._on_training_end()
        self._visitation.count(self._extent())

    def _extent(self) -> tuple[float, float, float, float]:
        bounds = self.model.policy.perceiver.bounds
        low, high = bounds.low.tolist(), bounds.high.tolist()
        across, up = self.dims
        return low[across], high[across], low[up], high[up]

    def _act(self) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(self.draw())
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3]
        write(picture_formats(self.logger), "map/value", Image(pixels, "HWC"), self.num_timesteps)
        if self.folder is not None:
            from matplotlib.image import imsave

            path = self.folder / f"value_map_{self.num_timesteps}.png"
            with replacing(path) as file:
                imsave(file, pixels, format="png")
            if self.verbose >= 1:
                print(f"Value map written to {path}")

    def draw(self) -> Figure:
        """
        :return: a figure of the current model; save it with ``figure.savefig(path)``
        """
        visitation = self._visitation
        visitation.count(self._extent())
        names = names_for(self.model, self.names)
        n_panels = count_panels(self.model) + 1
        n_rows = -(-n_panels // COLUMNS)
        figure = new_figure(4.6 * COLUMNS, 4.2 * n_rows)
        figure.set_dpi(DPI)
        panels = figure.subplots(n_rows, COLUMNS, sharex=True, sharey=True, squeeze=False).flatten().tolist()
        for empty in panels[n_panels:]:
            empty.set_axis_off()
        value_axes, *_ = plot_value_function(
            self.model, self.dims, self.fixed, self.resolution, panels[: n_panels - 1], names, self.average
        )
        visits = plot_visits(visitation.counts, self._extent(), panels[n_panels - 1])
        visits.set_xlabel(names.observations[self.dims[0]])
        plot_routes(list(visitation.trajectories), self.dims, value_axes)
        notes = [f"step {self.num_timesteps:,}"]
        if visitation.trajectories:
            n_routes = len(visitation.trajectories)
            notes.append(f"lines: the last {f'{n_routes} episodes' if n_routes > 1 else 'episode'}")
        notes.append(caption_of(value_grid(self.model, self.dims, self.fixed, 1, self.average), names))
        figure.suptitle(textwrap.fill("; ".join(filter(None, notes)), 150), fontsize="medium", color="0.3")
        return figure
