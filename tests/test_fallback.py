"""Without a usable numba or a numba cache everything still works, with a warning."""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.overrides import TorchFunctionMode
from toy_envs import DriftEnv

from sb3_knntd import KNNTD

HERE = pathlib.Path(__file__).parent
PACKAGE = HERE.parent / "sb3_knntd"


def learn(search: str = "auto", n_envs: int = 1, **arguments: Any) -> KNNTD:
    """A run that does not depend on rounding: the action values are never nearly equal."""
    env = DummyVecEnv([lambda n=n: DriftEnv(offset=0.3 * n) for n in range(n_envs)])
    points: Any = (8, 6)
    if search in ("kd_tree", "hnsw"):
        points = np.random.default_rng(5).uniform(DriftEnv.LOW, DriftEnv.HIGH, size=(40, 2))
    chosen: dict[str, Any] = {"learning_rate": 0.2, "gamma": 0.97, "trace_decay": 0.8, "n_neighbors": 4, "seed": 0}
    chosen |= {"points": points, "bounds": (DriftEnv.LOW, DriftEnv.HIGH), "search": search, "tie_break": "first"}
    return KNNTD(env, **{**chosen, **arguments}).learn(300 * n_envs)


RUNS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "lattice": {"search": "lattice"},
    "kd_tree": {"search": "kd_tree"},
    "environments": {"n_envs": 3, "traces": "accumulating", "learning_rate": 0.1},
}

# A process without numba: it trains and saves the same models, and tries what needs numba.
WITHOUT = """
import json, sys, warnings
with warnings.catch_warnings(record=True) as at_import:
    warnings.simplefilter("always")
    import test_fallback as shared
    from sb3_knntd import KNNTD
from sb3_knntd.learners import TorchLearner
import numpy as np

folder = sys.argv[1]
report = {"import": [str(w.message) for w in at_import if "numba" in str(w.message)], "runs": {}}
for name, arguments in shared.RUNS.items():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = shared.learn(**arguments)
    np.save(f"{folder}/{name}.npy", model.policy.q_table.numpy())
    report["runs"][name] = {
        "warnings": [[w.category.__name__, str(w.message)] for w in caught if "numba" in str(w.message)],
        "torch": isinstance(model.learner, TorchLearner) and not model.policy.is_compiled,
        "search": model.policy.search_name,
    }
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    asked = shared.learn(policy_kwargs={"compiled": False})
report["asked for torch"] = [str(w.message) for w in caught if "numba" in str(w.message)]
warnings.simplefilter("ignore")
shared.learn().save(f"{folder}/model")
loaded = KNNTD.load(f"{folder}/model")
report["loaded"] = bool((loaded.policy.q_table.numpy() == np.load(f"{folder}/defaults.npy")).all())
report["actions"] = model.predict(np.zeros((3, 2), np.float32), deterministic=True)[0].tolist()
report["refused"] = {}
for name, arguments in {
    "hashed": {"policy_kwargs": {"table": "hashed"}},
    "large": {"points": (10_000, 10_000), "search": "lattice"},
}.items():
    try:
        shared.learn(**arguments)
        report["refused"][name] = None
    except ValueError as error:
        report["refused"][name] = str(error)
print(json.dumps(report))
"""


def run_without(folder: pathlib.Path, **environment: str) -> dict[str, Any]:
    paths = [environment.pop("PYTHONPATH", ""), str(HERE), str(HERE.parent)]
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT, str(folder)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **environment},
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    report: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
    return {**report, "folder": folder}


@pytest.fixture(scope="module", params=["disabled", "broken"])
def without(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The report of a process without numba, and the reason."""
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "disabled":
        return {**run_without(folder, NUMBA_DISABLE_JIT="1"), "reason": "NUMBA_DISABLE_JIT"}
    # A numba that is incompatible with the installed NumPy raises this instead of an ImportError.
    (folder / "numba").mkdir()
    (folder / "numba" / "__init__.py").write_text("raise SystemError('bad initialization')\n")
    return {**run_without(folder, PYTHONPATH=str(folder)), "reason": "bad initialization"}


def test_a_warning_gives_the_reason(without: dict[str, Any]) -> None:
    for run in without["runs"].values():
        assert len(run["warnings"]) == 1
        ((category, message),) = run["warnings"]
        assert category == "UserWarning"
        assert message.startswith("numba cannot be used")
        assert without["reason"] in message
        assert "torch" in message
    # No warning at import, nor if torch operations were requested.
    assert without["import"] == []
    assert without["asked for torch"] == []


@pytest.mark.parametrize("name", RUNS)
def test_the_same_is_learned_by_torch_operations(without: dict[str, Any], name: str) -> None:
    assert without["runs"][name]["torch"]
    model = learn(**RUNS[name])
    assert model.policy.is_compiled
    expected = model.policy.q_table.numpy()
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(np.load(without["folder"] / f"{name}.npy"), expected, rtol=1e-9, atol=1e-9)


def test_files_are_interchangeable(without: dict[str, Any]) -> None:
    assert without["loaded"]
    assert len(without["actions"]) == 3
    model = KNNTD.load(without["folder"] / "model")
    assert model.policy.is_compiled
    np.testing.assert_array_equal(model.policy.q_table.numpy(), np.load(without["folder"] / "defaults.npy"))


@pytest.mark.parametrize("table", ["hashed", "large"])
def test_hashed_tables_are_refused(without: dict[str, Any], table: str) -> None:
    message = without["refused"][table]
    assert message is not None
    assert "numba" in message
    assert "'table': 'dense'" in message


NOWHERE = """
import sb3_knntd, test_fallback as shared
assert sb3_knntd.__file__.startswith({folder!r}), sb3_knntd.__file__
# Without a cache everything else would have to be compiled, which takes long.
print(shared.learn(policy_kwargs={{"compiled": False}}).policy.q_table.sum().item())
"""


def test_numba_without_a_cache_folder(tmp_path: pathlib.Path) -> None:
    # As in a container with a read-only file system and no home folder. numba raises an error when a function is
    # decorated, at import; this must not end the program.
    shutil.copytree(PACKAGE, tmp_path / "sb3_knntd", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in (tmp_path / "sb3_knntd").rglob("*"):
        if folder.is_dir():
            (folder / "__pycache__").touch()
    environment = {
        name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    }
    environment |= {"HOME": os.devnull, "PYTHONPATH": f"{tmp_path}{os.pathsep}{HERE}", "MPLCONFIGDIR": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", NOWHERE.format(folder=str(tmp_path))],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr[-1500:]
    assert "compiled anew" in run.stderr
    assert "has no folder for its cache" in run.stderr
    assert float(run.stdout) == pytest.approx(learn().policy.q_table.sum().item(), rel=1e-9)


CACHED = """
import sys, warnings
warnings.simplefilter("always")
from sb3_knntd.kernels.traces import insert, rehash
import numpy as np
slots = np.full((8, 2), -1, np.int64)
rehash(np.arange(3), 3, slots)
insert(7, 3, slots)
print(sorted(slots[slots[:, 0] >= 0].tolist()))
"""


def find_with(cache: pathlib.Path, first: str = "") -> str:
    """What is said on the standard error when a few kernels are compiled with the cache in a folder."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", first + CACHED]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr[-1500:]
    assert run.stdout == "[[0, 0], [1, 1], [2, 2], [7, 3]]\n"
    return run.stderr


def cut(content: bytes) -> bytes:
    """Truncate a file to its first half."""
    return content[: len(content) // 2]


def flip(content: bytes) -> bytes:
    """Flip a bit in the middle of a file."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A filled cache."""
    folder = tmp_path_factory.mktemp("cache")
    assert "compiled anew" not in find_with(folder)
    return folder


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [(".nbi", cut), (".nbi", lambda _: b"garbage"), (".nbi", lambda _: b""), (".nbc", cut), (".nbc", flip)],
    ids=["index cut", "index garbage", "index empty", "code cut", "code flipped"],
)
def test_a_damaged_cache_is_replaced(
    cache: pathlib.Path, tmp_path: pathlib.Path, suffix: str, damage: Callable[[bytes], bytes]
) -> None:
    shutil.copytree(cache, tmp_path, dirs_exist_ok=True)
    files = list(tmp_path.rglob(f"*{suffix}"))
    assert files
    for file in files:
        file.write_bytes(damage(file.read_bytes()))
    warned = find_with(tmp_path)
    assert warned.count("RuntimeWarning: the kernels are compiled anew") == 1
    assert "cannot be read" in warned
    assert "compiled anew" not in find_with(tmp_path), "the next process finds it mended"


def test_a_full_disk_keeps_no_kernel(tmp_path: pathlib.Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        warned = find_with(disk)
    finally:
        subprocess.run(["umount", str(disk)], check=True)
    assert warned.count("RuntimeWarning: the kernels are compiled anew") == 1
    assert "No space left" in warned


AT_ONCE = """
from sb3_knntd.kernels import progress
progress.PATIENCE = 0.0
import numba
numba.njit(lambda: 1)()
"""


def test_the_first_use_says_what_is_compiled(tmp_path: pathlib.Path) -> None:
    said = find_with(tmp_path, AT_ONCE)
    assert said.count("sb3_knntd compiles for this machine") == 1
    assert "python -m sb3_knntd.kernels" in said
    # A line for a kernel, and none for what it consists of or functions of other packages.
    lines = [line.strip() for line in said.splitlines() if line.endswith(" s")]
    assert [line.split(" ...")[0] for line in lines] == ["rehash"]
    assert find_with(tmp_path, AT_ONCE) == "", "nothing is compiled the second time"


# ------------------------------------------------------------------------------------------ accelerators

cuda = pytest.mark.skipif(not th.cuda.is_available(), reason="there is no CUDA device here")


@cuda
@pytest.mark.parametrize("name", ["defaults", "environments", "kd_tree"])
def test_the_same_is_learned_on_an_accelerator(name: str) -> None:
    there = learn(**RUNS[name], device="cuda")
    assert there.policy.device.type == "cuda"
    assert not there.policy.is_compiled
    expected = learn(**RUNS[name]).policy.q_table.numpy()
    np.testing.assert_allclose(there.policy.q_table.cpu().numpy(), expected, rtol=1e-6, atol=1e-6)


@cuda
def test_hashed_tables_are_refused_on_an_accelerator() -> None:
    with pytest.raises(ValueError, match="CPU"):
        learn(policy_kwargs={"table": "hashed"}, device="cuda")


class Waits(TorchFunctionMode):
    """Counts transfers of tensor values to Python, each of which synchronises with the device."""

    NAMES = ("cpu", "item", "tolist", "numpy", "nonzero", "__bool__", "__int__", "__float__", "__index__", "equal")

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        # Fetched values are in host memory and need no further synchronisation.
        fetched = name == "numpy" and self.counts["cpu"] > self.counts["numpy"]
        if name in self.NAMES:
            self.counts[name] += 1
            self.counts["waits"] += not fetched
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=cuda)])
@pytest.mark.parametrize("n_envs", [1, 5])
def test_torch_operations_synchronise_once_per_step(device: str, n_envs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model = learn(n_envs=n_envs, device=device, policy_kwargs={"compiled": False}, search="brute")
    counted: list[Counter[str]] = []
    learn_step = model.learner.step

    def counting(*arguments: Any) -> Any:
        with Waits() as waits:
            answer = learn_step(*arguments)
        counted.append(waits.counts)
        return answer

    monkeypatch.setattr(model.learner, "step", counting)
    model.learn(60 * n_envs, log_interval=None)
    assert len(counted) == 60
    # The actions must be fetched. On the CPU the errors are also checked, which costs nothing there.
    allowed = 2 if device == "cpu" else 1
    assert {counts["cpu"] for counts in counted} == {1}
    assert max(counts["waits"] for counts in counted) <= allowed
