"""TensorBoard in a browser, with a run of each algorithm."""

from __future__ import annotations

import importlib
import pathlib
from collections.abc import Iterator
from typing import Any

import pytest

ROOT = pathlib.Path(__file__).parent.parent


@pytest.fixture(scope="module")
def screenshots() -> Iterator[Any]:
    """The script that makes the screenshots of the documentation."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs"))
        module = importlib.import_module("screenshots")
        if module.find_chromium() is None:
            pytest.skip(f"no browser to look with: none of {', '.join(module.CHROMIUM)} is on the PATH")
        yield module


@pytest.fixture(scope="module")
def board(screenshots: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Any]]:
    """TensorBoard's address and a browser page, for short runs of both algorithms with all callbacks."""
    logs = screenshots.train(tmp_path_factory.mktemp("runs"), n_steps=2000, n_pictures=1)
    with screenshots.open_tensorboard(logs) as opened:
        yield opened


RUNS = ["KNNTD_1", "ExA_1"]


# A missing element raises a TimeoutError that names it.


def test_scalars_are_shown(screenshots: Any, board: tuple[str, Any]) -> None:
    url, page = board
    screenshots.show(page, url, "scalars")
    for run in RUNS:
        page.get_by_text(run, exact=True).filter(visible=True).first.wait_for()
    for tag in screenshots.SCALARS:
        chart = page.locator("tf-scalar-card:visible", has_text=tag)
        curves = [path.get_attribute("d") or "" for path in chart.locator("path.line").all()]
        # Each run has a point for each of its logs.
        assert sum(curve.count("L") >= 10 for curve in curves) >= len(RUNS), tag


def test_images_are_shown(screenshots: Any, board: tuple[str, Any]) -> None:
    url, page = board
    screenshots.show(page, url, "images")
    for tag in screenshots.IMAGES:
        cards = page.locator("tf-image-loader", has_text=tag)
        assert cards.count() == len(RUNS)
        for card in cards.all():
            card.get_by_text("2,000").first.wait_for()
            width, height = card.locator("img").first.evaluate("image => [image.naturalWidth, image.naturalHeight]")
            assert width > 200
            assert height > 100


def test_hparams_are_shown(screenshots: Any, board: tuple[str, Any]) -> None:
    url, page = board
    screenshots.show(page, url, "hparams")
    for run in RUNS:
        page.get_by_text(run, exact=True).filter(visible=True).first.wait_for()
    # TensorBoard lists the hyperparameters of only one run: those of the other algorithm may be missing.
    for name in ("algorithm", "env", "gamma", "learning_rate", "n_neighbors", "trace_decay"):
        page.get_by_text(name, exact=True).filter(visible=True).first.wait_for()
    for metric in ("rollout/ep_rew_mean", "rollout/ep_len_mean", "train/td_error", "time/fps"):
        page.get_by_text(metric, exact=True).first.wait_for(state="attached")
    # The first episodes of Mountain-Car have 200 steps with a reward of -1.
    page.locator("vaadin-grid-cell-content", has_text="-200.00").first.wait_for()
