"""Files are written atomically to the requested place, and no code in them is run."""

from __future__ import annotations

import io
import json
import os
import pathlib
import pickle
import shutil
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from algorithms import ALGORITHMS
from gymnasium import spaces
from sb3_knntd.callbacks import EpisodeVideoCallback, TableCheckpointCallback, ValueMapCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from toy_envs import DriftEnv

from sb3_knntd import KNNTD, DeltaFilter, ExA, KNNDyna, VecDeltaFilter
from sb3_knntd.common.files import replace_file
from sb3_knntd.common.plain import decode, encode

MakeModel = Callable[..., KNNTD | ExA | KNNDyna]
MakeVenv = Callable[..., VecEnv]
POSIX = pytest.mark.skipif(os.name != "posix", reason="links, permissions and locks of POSIX systems")


# ------------------------------------------------------------------------------ where they are written


@POSIX
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_overwriting_keeps_link_and_permissions(make_model: MakeModel, tmp_path: pathlib.Path, mode: int) -> None:
    there, link = tmp_path / "disk" / "model.zip", tmp_path / "model.zip"
    there.parent.mkdir()
    there.write_bytes(b"old")
    there.chmod(mode)
    link.symlink_to(there)
    make_model().save(link)
    assert link.is_symlink()
    assert zipfile.is_zipfile(there)
    assert stat.S_IMODE(there.stat().st_mode) == mode
    assert [path.name for path in there.parent.iterdir()] == ["model.zip"]


@POSIX
def test_a_link_to_nowhere_gets_its_file(tmp_path: pathlib.Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "there")
    replace_file(tmp_path / "link", b"new")
    assert (tmp_path / "there").read_bytes() == b"new"
    assert (tmp_path / "link").is_symlink()


@pytest.mark.parametrize("letter", ["x", "é", "語"])
def test_a_name_can_be_as_long_as_the_file_system_takes(
    make_model: MakeModel, tmp_path: pathlib.Path, letter: str
) -> None:
    longest = os.pathconf(tmp_path, "PC_NAME_MAX") if hasattr(os, "pathconf") else 255
    path = tmp_path / (letter * ((longest - 4) // len(letter.encode())) + ".zip")
    make_model().save(path)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


# ----------------------------------------------------------------------- files of killed processes

WRITE_AND_WAIT = """
import sys, time
from sb3_knntd.common.files import replacing
with replacing(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    print("begun", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def begin_writing() -> Iterator[Callable[[pathlib.Path], subprocess.Popen[str]]]:
    """A function that starts a process with a partially written file; closing its standard input lets it finish."""
    writers = []

    def begin(path: pathlib.Path) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", WRITE_AND_WAIT, str(path)]
        writers.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        assert writers[-1].stdout is not None
        assert writers[-1].stdout.readline() == "begun\n"
        return writers[-1]

    yield begin
    for writer in writers:
        writer.kill()
        writer.communicate()


def names(folder: pathlib.Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("left", "saved"),
    [
        ("model.zip", "model.zip"),
        ("run_100_steps.zip", "run_2000_steps.zip"),
        ("x" * 251 + ".zip", "x" * 251 + ".zip"),
    ],
)
def test_files_of_a_killed_process_are_removed_by_the_next(
    tmp_path: pathlib.Path, begin_writing: Callable[..., subprocess.Popen[str]], left: str, saved: str
) -> None:
    writer = begin_writing(tmp_path / left)
    writer.kill()
    writer.wait()
    assert len(names(tmp_path)) == 1
    replace_file(tmp_path / saved, b"whole")
    assert names(tmp_path) == [saved]


@pytest.mark.parametrize("left", ["other.zip", "run_2_100_steps.zip", "run_best.zip"])
def test_temporary_files_of_other_files_are_kept(
    tmp_path: pathlib.Path, begin_writing: Callable[..., subprocess.Popen[str]], left: str
) -> None:
    writer = begin_writing(tmp_path / left)
    writer.kill()
    writer.wait()
    replace_file(tmp_path / "run_100_steps.zip", b"whole")
    assert len(names(tmp_path)) == 2


def test_temporary_files_of_running_processes_are_kept(
    tmp_path: pathlib.Path, begin_writing: Callable[..., subprocess.Popen[str]]
) -> None:
    writer = begin_writing(tmp_path / "model.zip")
    replace_file(tmp_path / "model.zip", b"whole")
    assert len(names(tmp_path)) == 2
    writer.communicate()
    assert writer.returncode == 0
    assert names(tmp_path) == ["model.zip"]
    assert (tmp_path / "model.zip").read_bytes() == b"half"


@pytest.mark.parametrize("other", ["run", "run_2"])
def test_a_callback_keeps_files_that_another_is_writing(
    make_model: MakeModel, tmp_path: pathlib.Path, begin_writing: Callable[..., subprocess.Popen[str]], other: str
) -> None:
    writer = begin_writing(tmp_path / f"{other}_40_steps.zip")
    callback = TableCheckpointCallback(tmp_path, save_freq=20, name_prefix="run", save_best=False)
    make_model().learn(60, callback=callback)
    writer.communicate()
    assert writer.returncode == 0
    assert f"{other}_40_steps.zip" in names(tmp_path)


def test_unfinished_checkpoints_do_not_accumulate(
    make_model: MakeModel, tmp_path: pathlib.Path, begin_writing: Callable[..., subprocess.Popen[str]]
) -> None:
    for name in ("run_13_steps.zip", "run_best.zip"):
        writer = begin_writing(tmp_path / name)
        writer.kill()
        writer.wait()
    callback = TableCheckpointCallback(tmp_path, save_freq=1000, name_prefix="run")
    make_model().learn(200, callback=callback)
    assert names(tmp_path) == ["run_200_steps.zip", "run_best.zip"]


# ----------------------------------------------------------------------------------------- a full disk


@pytest.fixture
def small_disk(tmp_path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A file system of 64 KiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    command = [mount or "mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if mount is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("what", ["map", "video", "checkpoint", "model", "filter"])
def test_a_full_disk_leaves_nothing_half_written(make_model: MakeModel, small_disk: pathlib.Path, what: str) -> None:
    def fill(folder: pathlib.Path) -> None:
        model = make_model()
        if what == "map":
            model.learn(50, callback=ValueMapCallback(folder=folder))
        elif what == "video":
            env = gym.make("MountainCar-v0", render_mode="rgb_array")
            KNNTD("MountainCar-v0", points=4).learn(50, callback=EpisodeVideoCallback(env, folder=folder, max_steps=99))
        elif what == "checkpoint":
            model.learn(50, callback=TableCheckpointCallback(folder))
        elif what == "model":
            model.save(folder / "model")
        else:
            VecDeltaFilter(make_vec_env("MountainCar-v0"), points=4).save(folder / "filter")

    (small_disk / "ballast").write_bytes(bytes(15 * 4096))
    with pytest.raises(OSError, match="No space"):
        fill(small_disk)
    assert names(small_disk) == ["ballast"]


# ---------------------------------------------------------------------------- nothing is run when read


class Attack:
    """Creates a file when it is unpickled."""

    def __init__(self, mark: pathlib.Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return (pathlib.Path.touch, (self.mark,))


def rewrite(path: pathlib.Path, change: Callable[[str, bytes], bytes | None], compression: int = 0) -> None:
    """Replace members of a zip file; ``None`` removes one."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            changed = change(name, content)
            if changed is not None:
                archive.writestr(name, changed)


def plant(path: pathlib.Path, mark: pathlib.Path) -> None:
    """Put code into all parts of a file that SB3 would unpickle, and into the metadata of a checkpoint."""
    import base64

    attack = pickle.dumps(Attack(mark))

    def change(name: str, content: bytes) -> bytes:
        if name == "data":
            data = json.loads(content)
            for value in data.values():
                if isinstance(value, dict) and ":serialized:" in value:
                    value[":serialized:"] = base64.b64encode(attack).decode()
            return json.dumps(data).encode()
        return attack if name.endswith((".pkl", "checkpoint.json")) else content

    rewrite(path, change)


# Arguments of models that JSON cannot represent, without user functions.
ORDINARY: dict[str, dict[str, Any]] = {
    "defaults": {},
    "schedules": {"learning_rate": LinearSchedule(0.8, 0.1, 1.0), "trace_decay": LinearSchedule(0.3, 0.9, 1.0)},
    "scattered": {"points": np.random.default_rng(5).uniform(DriftEnv.LOW, DriftEnv.HIGH, size=(30, 2))},
    "bounds": {"bounds": (DriftEnv.LOW, DriftEnv.HIGH)},
    "numbers of numpy": {"learning_rate": np.float64(0.3), "gamma": np.float32(0.5), "n_neighbors": np.int64(3)},
    "half size": {"policy_kwargs": {"dtype": th.float32}},
}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("name", ORDINARY)
def test_an_ordinary_model_needs_no_trust(
    algorithm: type[KNNTD | ExA | KNNDyna],
    make_model: MakeModel,
    make_venv: MakeVenv,
    tmp_path: pathlib.Path,
    name: str,
) -> None:
    model = make_model(**ORDINARY[name]).learn(101)
    model.save(tmp_path / "model.zip")
    trusted = algorithm.load(tmp_path / "model.zip", env=make_venv(1))
    plant(tmp_path / "model.zip", tmp_path / "mark")
    loaded = algorithm.load(tmp_path / "model.zip", env=make_venv(1), trusted=False)
    assert not (tmp_path / "mark").exists()
    assert loaded.observation_space == model.observation_space
    assert loaded.action_space == model.action_space
    assert loaded.num_timesteps == 101
    for one in (trusted, loaded):
        one.learn(101, reset_num_timesteps=False)
    assert th.equal(trusted.policy.q_table, loaded.policy.q_table)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3),
        spaces.Discrete(3, start=-1),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiDiscrete([2, 3], start=[1, 1]),
        spaces.MultiBinary(3),
        spaces.MultiBinary([2, 2]),
        spaces.Box(-1, np.inf, (2,)),
        spaces.Box(np.array([0, 1]), np.array([5, 6]), dtype=np.int8),
    ],
    ids=str,
)
def test_spaces_are_data(space: spaces.Space[Any]) -> None:
    again = decode(json.loads(json.dumps(encode(space))))
    assert again == space
    assert again.dtype == space.dtype


def test_without_trust_a_function_is_refused_and_named(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model(weights=lambda squared: (1.0 + squared) ** -2)
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"weights is pickled.*trusted=True"):
        type(model).load(tmp_path / "model.zip", trusted=False)
    given = {"weights": "gaussian"}
    assert type(model).load(tmp_path / "model.zip", trusted=False, custom_objects=given).weights == "gaussian"
    assert callable(type(model).load(tmp_path / "model.zip").weights)


def test_an_old_file_needs_trust(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model().learn(100)
    model.save(tmp_path / "model.zip")

    def without_plain(name: str, content: bytes) -> bytes:
        return json.dumps({k: v for k, v in json.loads(content).items() if k != "plain"}).encode()

    rewrite(tmp_path / "model.zip", lambda name, content: without_plain(name, content) if name == "data" else content)
    assert th.equal(type(model).load(tmp_path / "model.zip").policy.q_table, model.policy.q_table)
    with pytest.raises(ValueError, match="trusted=True"):
        type(model).load(tmp_path / "model.zip", trusted=False)


@pytest.mark.parametrize(
    "code",
    [
        {":plain:": "array", "of": ["O", [1], "AAAAAAAAAAA="]},
        {":plain:": "array", "of": ["<f8", [10**12], ""]},
        {":plain:": "array", "of": ["<f8", [-1], "AAAAAAAAAAA="]},
        {":plain:": "class", "of": ["os.system"]},
        {":plain:": "class", "of": [{}]},
        {":plain:": "no such", "of": []},
        {":plain:": [], "of": []},
        {":plain:": "box"},
        {":plain:": "box", "of": [1, 2, "no type"]},
        {":plain:": "discrete", "of": [-3, 0, "<i8"]},
        {":plain:": "float_schedule", "of": [{":plain:": "class", "of": ["sb3_knntd.policies.KNNPolicy"]}]},
        {":plain:": "dtype", "of": ["load"]},
        {":plain:": "deque", "of": [3, 4]},
    ],
    ids=str,
)
def test_invalid_pickles_are_refused(code: Any) -> None:
    with pytest.raises(ValueError, match="no object can be made"):
        decode(code)


def test_learning_beside_a_planted_checkpoint_runs_nothing(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model()
    model.learn(200, callback=TableCheckpointCallback(tmp_path, save_freq=50))
    mark = tmp_path / "mark"
    plant(tmp_path / "checkpoint_best.zip", mark)
    with pytest.raises(ValueError, match="is no checkpoint"):
        model.learn(100, callback=TableCheckpointCallback(tmp_path), reset_num_timesteps=False)
    # In the previous file format.
    rewrite(tmp_path / "checkpoint_best.zip", lambda name, content: None if name == "checkpoint.json" else content)
    with zipfile.ZipFile(tmp_path / "checkpoint_best.zip", "a") as archive:
        archive.writestr(
            "checkpoint.pkl", pickle.dumps({"algorithm": Attack(mark), "wrappers": [], "mean_reward": 0.0})
        )
    with pytest.raises(ValueError, match="is no checkpoint"):
        model.learn(100, callback=TableCheckpointCallback(tmp_path), reset_num_timesteps=False)
    assert not mark.exists()


def test_old_checkpoints_can_be_continued(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model()
    callback = TableCheckpointCallback(tmp_path)
    model.learn(200, callback=callback)
    for path in tmp_path.glob("*.zip"):
        rewrite(path, lambda name, content: None if name == "checkpoint.json" else content)
        with zipfile.ZipFile(path, "a") as archive:
            notes = {"algorithm": type(model), "wrappers": [], "mean_reward": callback.best_mean_reward}
            archive.writestr("checkpoint.pkl", pickle.dumps(notes))
    resumed = TableCheckpointCallback.resume(tmp_path, model.get_env())  # type: ignore[arg-type]
    again = TableCheckpointCallback(tmp_path)
    resumed.learn(1, callback=again, reset_num_timesteps=False)
    assert again.best_mean_reward is not None
    assert callback.best_mean_reward is not None
    assert again.best_mean_reward >= callback.best_mean_reward


def test_resuming_without_trust(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    venv = VecDeltaFilter(DummyVecEnv([DriftEnv]), points=4, bounds=(DriftEnv.LOW, DriftEnv.HIGH))
    KNNTD(venv, points=4).learn(100, callback=TableCheckpointCallback(tmp_path / "filter"))
    resumed = TableCheckpointCallback.resume(tmp_path / "filter", DummyVecEnv([DriftEnv]), trusted=False)
    assert isinstance(resumed.get_env(), VecDeltaFilter)

    KNNTD(VecNormalize(DummyVecEnv([DriftEnv])), points=4).learn(
        100, callback=TableCheckpointCallback(tmp_path / "norm")
    )
    for path in (tmp_path / "norm").glob("*_steps.zip"):
        plant(path, tmp_path / "mark")
        rewrite(path, lambda name, content: json.dumps(NOTES).encode() if name == "checkpoint.json" else content)
    with pytest.raises(ValueError, match="VecNormalize is saved by pickle"):
        TableCheckpointCallback.resume(tmp_path / "norm", DummyVecEnv([DriftEnv]), trusted=False)
    assert not (tmp_path / "mark").exists()


NOTES = {
    "algorithm": "sb3_knntd.knntd.KNNTD",
    "wrappers": ["stable_baselines3.common.vec_env.vec_normalize.VecNormalize"],
    "mean_reward": 0.0,
}


@pytest.mark.parametrize("name", ["os.system", "antigravity.KNNTD", 7, "sb3_knntd.exa.ExAA"])
def test_a_checkpoint_imports_nothing(make_model: MakeModel, tmp_path: pathlib.Path, name: Any) -> None:
    make_model().learn(50, callback=TableCheckpointCallback(tmp_path, save_best=False))
    notes = {**NOTES, "algorithm": name, "wrappers": []}
    for path in tmp_path.glob("*.zip"):
        rewrite(path, lambda name, content: json.dumps(notes).encode() if name == "checkpoint.json" else content)
    with pytest.raises(ValueError, match="import its module first"):
        TableCheckpointCallback.resume(tmp_path, DriftEnv())


def test_reading_a_filter_runs_nothing(tmp_path: pathlib.Path) -> None:
    def env() -> DriftEnv:
        return DriftEnv()

    bounds = (DriftEnv.LOW, DriftEnv.HIGH)
    schedule = LinearSchedule(0.5, 0.1, 1.0)
    DeltaFilter(env(), points=4, bounds=bounds, learning_rate=schedule, total_timesteps=10).save(
        tmp_path / "filter.zip"
    )
    plant(tmp_path / "filter.zip", tmp_path / "mark")
    loaded = DeltaFilter.load(tmp_path / "filter.zip", env())
    assert loaded.table.rate() == 0.5
    assert not (tmp_path / "mark").exists()
    DeltaFilter(env(), points=4, weights=lambda squared: 1.0 / (1.0 + squared)).save(tmp_path / "other.zip")
    with pytest.raises(ValueError, match=r"arguments is pickled.*trusted=True"):
        DeltaFilter.load(tmp_path / "other.zip", env())
    DeltaFilter.load(tmp_path / "other.zip", env(), trusted=True)


# ------------------------------------------------------------------------------------------- too large


@pytest.mark.parametrize("inner", [False, True], ids=["zip", "zip of torch in the zip"])
def test_a_small_file_that_decompresses_to_gigabytes_is_refused(
    make_model: MakeModel, tmp_path: pathlib.Path, inner: bool
) -> None:
    path = tmp_path / "model.zip"
    model = make_model()
    model.save(path)
    content = io.BytesIO()
    with (
        zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as bomb,
        bomb.open("archive/data/0", "w", force_zip64=True) as part,
    ):
        for _ in range(200):
            part.write(bytes(2**20))
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        if inner:
            archive.writestr("other.pth", content.getvalue())
        else:
            archive.writestr("other", bytes(200 * 2**20))
    assert path.stat().st_size < 2**20
    with pytest.raises(ValueError, match="would unfold from"):
        type(model).load(path)


def test_a_file_that_was_compressed_is_read(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    model = make_model()
    model.save(tmp_path / "model.zip")
    rewrite(tmp_path / "model.zip", lambda name, content: content, zipfile.ZIP_DEFLATED)
    type(model).load(tmp_path / "model.zip")


# -------------------------------------------------------------------------------------------------- invalid states


@pytest.mark.parametrize(
    "kind",
    [
        "dense",
        "hashed",
        pytest.param("adaptive", marks=pytest.mark.slow),
        pytest.param("torch", marks=pytest.mark.slow),
    ],
)
def test_a_modified_state_is_loaded_or_refused(tmp_path: pathlib.Path, kind: str) -> None:
    fuzz = pathlib.Path(__file__).with_name("fuzz_states.py")
    command = [sys.executable, str(fuzz), kind, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    # A separate process, because it may crash.
    assert done.returncode == 0, done.stdout[-300:] + done.stderr[-3000:]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("capacity", 10**12, r"capacity must be an integer within \[\d+, \d+\]; got 1000000000000"),
        ("points", th.tensor([3, 3]), "points must differ"),
        ("points", th.tensor([10**9]), r"points must be within \[0, 35\]"),
        ("pace", th.tensor([0.0, 0.0], dtype=th.float64), "pace must begin with"),
    ],
)
def test_what_is_wrong_with_a_state_is_named(
    make_model: MakeModel, tmp_path: pathlib.Path, name: str, value: Any, message: str
) -> None:
    model = make_model(points=6).learn(101)
    model.save(tmp_path / "model.zip")
    state = model.learner.state_dict()
    state["traces"][name] = value
    with pytest.raises(ValueError, match=message):
        model.learner.load_state_dict(state)
    content = io.BytesIO()
    th.save(state, content)
    rewrite(tmp_path / "model.zip", lambda name, old: content.getvalue() if name == "learner.pth" else old)
    with pytest.raises(ValueError, match=message):
        type(model).load(tmp_path / "model.zip")
    # The state was refused before any part of it was loaded.
    model.learn(101, reset_num_timesteps=False)


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("_stream_states", [{"key": [1, 2], "position": -5}] * 2),
        ("_stream_states", [{"key": [1, 2**64], "position": 5}] * 2),
        ("_stream_states", [{"key": [1], "position": 5}] * 2),
        ("_stream_states", [{"key": 1.5, "position": 5}] * 2),
        ("_last_obs", [[0.0, 0.0]]),
        ("_last_obs", encode(np.zeros((1, 1), np.float32))),
    ],
)
def test_other_invalid_data_is_refused(
    make_model: MakeModel, make_venv: MakeVenv, tmp_path: pathlib.Path, attribute: str, value: Any
) -> None:
    model = make_model().learn(101)
    model.save(tmp_path / "model.zip")

    def change(name: str, content: bytes) -> bytes:
        if name != "data":
            return content
        data = json.loads(content)
        if isinstance(value, dict):
            data["plain"][attribute] = value
        else:
            data[attribute] = value
        return json.dumps(data).encode()

    rewrite(tmp_path / "model.zip", change)
    with pytest.raises(ValueError, match=r"must be|must have"):
        type(model).load(tmp_path / "model.zip", env=make_venv(1), force_reset=False, trusted=False)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("points", th.tensor([10**9])),
        ("deltas", th.full((1, 3, 2), np.nan, dtype=th.float64)),
        ("visits", th.zeros(1)),
        ("gains", th.tensor([2.0, 2.0], dtype=th.float64)),
        ("n_steps", "many"),
    ],
)
def test_an_invalid_filter_state_is_refused(name: str, value: Any) -> None:
    table = DeltaFilter(DriftEnv(), points=4, bounds=(DriftEnv.LOW, DriftEnv.HIGH)).table
    state = table.state_dict()
    state |= {"points": th.tensor([0]), "deltas": th.zeros((1, 3, 2)).double(), "visits": th.zeros((1, 3)).double()}
    table.load_state_dict(state)
    with pytest.raises(ValueError, match=name):
        table.load_state_dict({**state, name: value})
