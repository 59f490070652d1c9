"""
Draw the pictures of docs/understanding.md: an explanation, and the page of a model in a headless Chromium.

    python docs/inspection_pictures.py [FOLDER]
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np
from playwright.sync_api import sync_playwright
from stable_baselines3.common.monitor import Monitor

from sb3_knntd import KNNTD
from sb3_knntd.insight import read_monitor, write_page
from sb3_knntd.plots import figure_of

CHROMIUM = "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images"
    chromium = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if chromium is None:
        sys.exit(f"no Chromium: none of {', '.join(CHROMIUM)} is on the PATH")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        env = Monitor(gym.make("MountainCar-v0"), str(Path(folder) / "run"))
        model = KNNTD(env, seed=0).learn(30_000)
        env.close()
        axes = model.explain(np.array([-0.4, 0.01], np.float32)).plot()
        figure_of(axes[0]).savefig(out / "explanation.png")

        page_file = Path(folder) / "page.html"
        write_page(model, page_file, read_monitor(Path(folder) / "run.monitor.csv"), env_id="MountainCar-v0")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        page.goto(page_file.as_uri())
        page.wait_for_load_state("networkidle")
        page.screenshot(path=out / "inspect_page.png", full_page=True)
        browser.close()
    for name in ("explanation.png", "inspect_page.png"):
        print(out / name)


if __name__ == "__main__":
    main()
