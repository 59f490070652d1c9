"""
Make the images of docs/callbacks.md: train both algorithms with every callback, open their logs in TensorBoard with a
headless Chromium, and take screenshots.

    python docs/screenshots.py [--out FOLDER]
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gymnasium as gym
from playwright.sync_api import Page, sync_playwright
from sb3_knntd.callbacks import (
    EpisodeVideoCallback,
    HParamCallback,
    PerceptionStatsCallback,
    TableCheckpointCallback,
    ValueMapCallback,
)
from stable_baselines3.common.callbacks import BaseCallback

from sb3_knntd.registry import ALGORITHMS

#: By algorithm, the environment that it learns, and the two dimensions that are drawn.
RUNS = {"knntd": ("MountainCar-v0", (0, 1)), "exa": ("Pendulum-v1", (0, 2))}
#: TensorBoard's address in its output.
ADDRESS = re.compile(r"http://\S+:\d+/")
CHROMIUM = "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"
CHROMIUM_ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
#: Scalars logged by the callbacks.
SCALARS = [
    "perception/neighbors",
    "perception/outside_share",
    "perception/visited_share",
    "train/policy_changes",
    "train/td_error_q05",
    "train/td_error_q50",
    "train/td_error_q95",
    "train/trace_length",
    "train/trace_points",
]
IMAGES = ["map/value", "video/episode"]
FILTER = "^perception|td_error_q|trace|policy"
#: TensorBoard's tabs, and the window size (width, height) that shows their whole content.
TABS = {"scalars": (1420, 1080), "images": (1420, 820), "hparams": (1420, 420)}
TIMEOUT = 60_000


def train(folder: Path, n_steps: int, n_pictures: int) -> Path:
    """
    Train each algorithm of :data:`RUNS` with all callbacks.

    :param folder: output folder, with one subfolder per algorithm
    :param n_steps: number of training steps per algorithm
    :param n_pictures: number of maps and of videos per algorithm
    :return: folder of TensorBoard's logs
    """
    for name, (env_id, dims) in RUNS.items():
        files, freq = folder / name, n_steps // n_pictures
        callbacks: list[BaseCallback] = [
            ValueMapCallback(dims=dims, average=True, draw_freq=freq, folder=files),
            PerceptionStatsCallback(log_freq=n_steps // 20),
            TableCheckpointCallback(files, save_freq=freq),
            EpisodeVideoCallback(gym.make(env_id, render_mode="rgb_array"), video_freq=freq, folder=files),
            HParamCallback(),
        ]
        algorithm = ALGORITHMS[name]
        model = algorithm.load()(algorithm.policy, env_id, seed=0, tensorboard_log=str(folder / "logs"))
        model.learn(n_steps, callback=callbacks)
    return folder / "logs"


def find_chromium() -> str | None:
    """
    :return: the Chromium or Chrome of this machine, ``None`` if there is none
    """
    return next(filter(None, map(shutil.which, CHROMIUM)), None)


@contextmanager
def open_tensorboard(logs: Path) -> Iterator[tuple[str, Page]]:
    """
    Start TensorBoard and a browser.

    :param logs: folder of TensorBoard's logs
    :return: TensorBoard's address, and a browser page
    :raises FileNotFoundError: if there is no Chromium
    """
    chromium = find_chromium()
    if chromium is None:
        raise FileNotFoundError(f"no Chromium: none of {', '.join(CHROMIUM)} is on the PATH")
    # Run in the parent folder, because TensorBoard displays the path it was given.
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", logs.name, "--host", "127.0.0.1", "--port", "0"]
    with subprocess.Popen(command, cwd=logs.parent, stderr=subprocess.PIPE, text=True) as board:
        try:
            assert board.stderr is not None
            url = next(match[0] for match in map(ADDRESS.search, board.stderr) if match)
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=chromium, args=CHROMIUM_ARGUMENTS)
                page = browser.new_page()
                page.set_default_timeout(TIMEOUT)
                yield url, page
                browser.close()
        finally:
            board.terminate()


def show(page: Page, url: str, tab: str) -> None:
    """
    Open one of TensorBoard's tabs and wait until it shows what was logged.

    :param page: browser page from :func:`open_tensorboard`
    :param url: address from :func:`open_tensorboard`
    :param tab: ``"scalars"``, ``"images"`` or ``"hparams"``
    :raises playwright.sync_api.TimeoutError: if something does not appear
    """
    width, height = TABS[tab]
    page.set_viewport_size({"width": width, "height": height})
    # The query forces a reload; a new fragment alone would not.
    page.goto(f"{url}?{tab}#{tab}")
    if tab == "scalars":
        # Only the first two groups are expanded; filter results always are.
        page.locator("tf-tag-filterer input").fill(FILTER)
        for tag in SCALARS:
            page.locator("tf-card-heading", has_text=tag).first.wait_for()
    elif tab == "images":
        for tag in IMAGES:
            page.locator("tf-image-loader", has_text=tag).locator("img").first.wait_for()
    else:
        page.get_by_text("rollout/ep_rew_mean").first.wait_for()
        page.get_by_text("KNNTD_1").first.wait_for()
    # Wait for the animations to finish.
    page.wait_for_timeout(2000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images", help="folder of the pictures")
    parser.add_argument("--steps", type=int, default=50_000, help="training steps of each algorithm")
    arguments = parser.parse_args()
    if find_chromium() is None:
        sys.exit(f"no Chromium: none of {', '.join(CHROMIUM)} is on the PATH")
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        logs = train(Path(folder), arguments.steps, 5)
        for name in RUNS:
            files = Path(folder) / name
            shutil.copyfile(
                files / f"value_map_{arguments.steps}.png", arguments.out / f"callback_value_map_{name}.png"
            )
            shutil.copyfile(files / f"episode_{arguments.steps}.gif", arguments.out / f"callback_episode_{name}.gif")
        with open_tensorboard(logs) as (url, page):
            for tab in TABS:
                show(page, url, tab)
                page.screenshot(path=arguments.out / f"tensorboard_{tab}.png")
    for path in sorted([*arguments.out.glob("callback_*"), *arguments.out.glob("tensorboard_*")]):
        print(path)


if __name__ == "__main__":
    main()
