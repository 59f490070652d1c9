"""RayVecEnv: behaves like SubprocVecEnv, on a local Ray cluster, some of whose processes and nodes die."""

from __future__ import annotations

import importlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from ray.cluster_utils import Cluster
from ray.util.client.server.server import serve
from ray_cluster import NODE, TESTS, loopback_cluster
from ray_envs import MortalEnv, ProbeEnv, SampleEnv
from stable_baselines3 import A2C
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_knntd import KNNTD, ExA
from sb3_knntd.distributed import ray_vec_env
from sb3_knntd.distributed.ray_vec_env import RayVecEnv

#: Reserve no resources: test machines have few cores, and nothing else runs on the cluster.
SHARED: dict[str, Any] = {"num_cpus": 0}
N_ENVS = 3
PROBES: list[Callable[[], gym.Env[Any, Any]]] = [
    partial(ProbeEnv, 4),
    lambda: Monitor(ProbeEnv(5, "truncated")),
    lambda: gym.wrappers.TimeLimit(gym.wrappers.OrderEnforcing(Monitor(ProbeEnv(9))), 6),
]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A cluster of a head without CPUs and one node; this process is connected to it."""
    with loopback_cluster(num_cpus=2, resources={"simulator": 2}) as made:
        yield made


@pytest.fixture(scope="module")
def venv(cluster: Cluster) -> Iterator[RayVecEnv]:
    """Three environments that record what is done to them; tests may leave them in any state."""
    made = RayVecEnv(PROBES, **SHARED)
    yield made
    made.close()


@pytest.fixture(scope="module")
def model_venv() -> Iterator[SubprocVecEnv]:
    """The same environments in SB3's SubprocVecEnv, the reference."""
    made = SubprocVecEnv(PROBES)
    yield made
    made.close()


@pytest.fixture(params=[SubprocVecEnv, RayVecEnv])
def either(request: pytest.FixtureRequest) -> VecEnv:
    """Both in turn."""
    made: VecEnv = request.getfixturevalue("venv" if request.param is RayVecEnv else "model_venv")
    return made


@pytest.fixture
def make_mortal(cluster: Cluster) -> Iterator[Callable[..., RayVecEnv]]:
    """A function ``make_mortal(n_envs, **arguments)`` that makes environments that can die."""
    made: list[RayVecEnv] = []

    def make(n_envs: int = 1, length: int = 10, **arguments: Any) -> RayVecEnv:
        made.append(RayVecEnv([partial(MortalEnv, length)] * n_envs, **{**SHARED, **arguments}))
        return made[-1]

    yield make
    for venv in made:
        venv.close()


def assert_same(one: Any, other: Any) -> None:
    """Assert bitwise equality of nested values, except for clock times."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one.keys() - {"t"}:
            assert_same(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, th.Tensor):
        assert th.equal(one, other)
    else:
        assert type(one) is type(other)
        np.testing.assert_array_equal(one, other, strict=isinstance(one, np.ndarray))


def live(venv: VecEnv, n_steps: int, seed: int = 3) -> Iterator[Any]:
    """The results of a reset and of random steps."""
    yield venv.reset()
    yield venv.reset_infos
    venv.action_space.seed(seed)
    for _ in range(n_steps):
        yield venv.step(np.stack([venv.action_space.sample() for _ in range(venv.num_envs)]))
        yield venv.reset_infos


# ------------------------------------------------------------- a SubprocVecEnv


def test_same_steps(venv: RayVecEnv, model_venv: SubprocVecEnv) -> None:
    for each in (venv, model_venv):
        assert each.seed(11) == [11, 12, 13]
        each.set_options([{"a": 1}, {}, {"b": np.arange(3)}])
    # Seeds and options apply to one reset, and the random numbers continue from there; therefore twice.
    for _ in range(2):
        for one, other in zip(live(venv, 14), live(model_venv, 14), strict=True):
            assert_same(one, other)


def test_seeds_and_options_reach_one_reset(either: VecEnv) -> None:
    either.seed(5)
    either.set_options({"size": 2})
    first = either.reset()
    assert [info["seed"] for info in either.reset_infos] == [5, 6, 7]
    assert [info["options"] for info in either.reset_infos] == [{"size": 2}] * 3
    assert not np.array_equal(either.reset(), first)
    assert [info["seed"] for info in either.reset_infos] == [None] * 3
    assert [info["options"] for info in either.reset_infos] == [None] * 3
    either.seed(5)
    assert np.array_equal(either.reset(), first)


def test_terminal_observations(either: VecEnv) -> None:
    observations = either.reset()
    ended = {0: 4, 1: 5, 2: 6}  # the last by a TimeLimit wrapper
    for step in range(1, 7):
        actions = np.zeros((N_ENVS, 3), np.float32)
        observations, rewards, dones, infos = either.step(actions)
        assert dones.tolist() == [step % ended[index] == 0 for index in range(N_ENVS)]
        for index, info in enumerate(infos):
            assert ("terminal_observation" in info) == dones[index]
            assert info["TimeLimit.truncated"] == (dones[index] and index != 0)
            if dones[index]:
                assert rewards[index] == np.float32(info["terminal_observation"].sum())
                assert rewards[index] != np.float32(observations[index].sum())
                assert ("episode" in info) == (index == 1)


@pytest.mark.parametrize("indices", [None, 1, [0, 2], [0, -1], range(2), [2, 2]])
def test_attributes_and_methods(venv: RayVecEnv, model_venv: SubprocVecEnv, indices: Any) -> None:
    for each in (venv, model_venv):
        each.reset()
        assert each.set_attr("knob", {"turned": np.arange(2)}, indices=indices) is None
    for ask in (
        lambda each: each.get_attr("knob", indices),
        lambda each: each.get_attr("knob"),
        lambda each: each.get_attr("length", indices),
        lambda each: each.env_method("scaled", 2.0, indices=indices, name=1.0),
        lambda each: each.env_is_wrapped(Monitor, indices),
        # Not TimeLimit: RL Zoo replaces it in gymnasium, but only in this process.
        lambda each: each.env_is_wrapped(gym.wrappers.OrderEnforcing, indices),
    ):
        assert_same(ask(venv), ask(model_venv))


def test_attributes_that_are_not_there(venv: RayVecEnv) -> None:
    assert venv.has_attr("length")
    assert not venv.has_attr("width")
    with pytest.raises(AttributeError, match="width"):
        venv.get_attr("width")
    with pytest.raises(IndexError):
        venv.get_attr("length", indices=[3])


def test_rendering(venv: RayVecEnv, model_venv: SubprocVecEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (venv.render_mode, venv.metadata) == ("rgb_array", {"render_modes": ["human", "rgb_array"]})
    assert_same(venv.get_images(), model_venv.get_images())
    assert_same(venv.render(), model_venv.render("rgb_array"))
    with pytest.warns(UserWarning, match="something_else"):
        assert venv.render("something_else") is None
    monkeypatch.setattr(venv, "render_mode", None)
    with pytest.warns(UserWarning, match="render_mode"):
        assert venv.render() is None
    with pytest.warns(UserWarning, match="None"):
        assert list(venv.get_images()) == [None] * 3


@pytest.mark.parametrize("wrap", [VecNormalize, partial(VecFrameStack, n_stack=2), VecMonitor])
def test_wrappers(venv: RayVecEnv, model_venv: SubprocVecEnv, wrap: Callable[[VecEnv], VecEnv]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of two monitors
        wrapped, expected = wrap(venv), wrap(model_venv)
    for each in (wrapped, expected):
        each.seed(2)
    for one, other in zip(live(wrapped, 12), live(expected, 12), strict=True):
        assert_same(one, other)


SPACES: dict[str, spaces.Space[Any]] = {
    "discrete": spaces.Discrete(4),
    "binary": spaces.MultiBinary(3),
    "image": spaces.Box(0, 255, (80, 80, 3), np.uint8),
}


def test_structured_observations(cluster: Cluster) -> None:
    structures = [spaces.Dict(SPACES), spaces.Tuple(list(SPACES.values()))]
    made = RayVecEnv([partial(SampleEnv, structures[0])], **SHARED)
    assert made.observation_space == structures[0]
    assert (made.render_mode, made.metadata) == (None, {"render_modes": []})
    for space in structures:
        made.set_attr("observation_space", space)
        made.observation_space = space
        expected = DummyVecEnv([partial(SampleEnv, space)])
        for each in (made, expected):
            each.seed(1)
        for one, other in zip(live(made, 6), live(expected, 6), strict=True):
            assert_same(one, other)
        # Ray's arrays are read-only; returned arrays must be writable.
        image = made.step(np.array([1]))[3][0]["seen"]["image" if isinstance(space, spaces.Dict) else 2]
        image += 1
    made.close()


@pytest.mark.parametrize("learner", [KNNTD, ExA, A2C])
def test_same_learning(
    venv: RayVecEnv, model_venv: SubprocVecEnv, learner: type[KNNTD | ExA | A2C], monkeypatch: pytest.MonkeyPatch
) -> None:
    learned: list[dict[str, Any]] = []
    episodes: list[Any] = []
    for each in (DummyVecEnv(PROBES), model_venv, venv):
        arguments: dict[str, Any] = {"seed": 7, "device": "cpu"}
        if learner is A2C:
            arguments["policy"] = "MlpPolicy"
        else:
            arguments |= {"points": 4, "bounds": ([-5] * 3, [5] * 3)}
        if learner is KNNTD:  # the random walk visits other observations, too
            monkeypatch.setattr(each, "action_space", spaces.Discrete(3))
        model = learner(env=each, **arguments).learn(900)
        learned.append(model.policy.state_dict())
        episodes.append([(info["r"], info["l"]) for info in model.ep_info_buffer or ()])
    assert len(episodes[0]) > 50
    assert_same(episodes[1], episodes[0])
    assert_same(episodes[2], episodes[0])
    for other in learned[1:]:
        assert_same(other, learned[0])


# ---------------------------------------------------- exceptions, and the end


def test_errors_of_environments_reach_the_user(venv: RayVecEnv) -> None:
    actions = np.zeros((N_ENVS, 3), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match="no luck today") as raised:
            venv.env_method("unlucky", indices=1)
        assert re.search(r"ray_envs\.py.*in unlucky", str(raised.value))
        venv.reset()
        with pytest.raises(ValueError, match="broadcast"):
            venv.step(np.zeros((N_ENVS, 5), np.float32))
        with pytest.raises(ValueError, match="zip"):
            venv.step(actions[:2])
        # They are alive, and none was restarted.
        venv.reset()
        assert [info["steps"] for info in venv.step(actions)[3]] == [1, 1, 1]
        assert venv.restarts == [0, 0, 0]


def test_a_reset_cancels_running_steps(venv: RayVecEnv) -> None:
    actions = np.zeros((N_ENVS, 3), np.float32)
    venv.reset()
    venv.step_async(actions)
    assert venv.waiting
    venv.reset()
    assert not venv.waiting
    assert [info["steps"] for info in venv.step(actions)[3]] == [1, 1, 1]


def test_errors_of_constructors_reach_the_user(cluster: Cluster) -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'mass'"):
        RayVecEnv([partial(ProbeEnv, mass=3)], **SHARED)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env_fns": []}, r"env_fns .* at least one; got \[\]"),
        ({"env_fns": ["CartPole-v1"]}, "env_fns must be functions.*CartPole"),
        ({"num_cpus": -1}, r"num_cpus must be a finite number in \[0, inf\); got -1"),
        ({"max_restarts": 1.5}, "max_restarts must be an integer >= 0; got 1.5"),
        ({"timeout": 0}, r"timeout must be a finite number in \(0, inf\); got 0"),
        ({"placement_timeout": "long"}, "placement_timeout must be a finite number.*'long'"),
        ({"actor_options": {"max_restarts": 2, "num_gpus": 1}}, "actor_options cannot have max_restarts"),
        ({"actor_options": {"wheels": 4}}, "actor_options=.*wheels"),
        ({"actor_options": {"num_gpus": "all"}}, "actor_options=.*'all'"),
        ({"actor_options": {1: 2}}, "actor_options=.*{1: 2}"),
        ({"actor_options": ["num_gpus"]}, r"actor_options must be a dict.*\['num_gpus'\]"),
        ({"env_fns": None}, "env_fns must be functions.*None"),
        ({"env_fns": 3}, "env_fns must be functions.*3"),
        ({"address": 8265}, "address must be 'auto'.*8265"),
        ({"num_cpus": True}, "num_cpus must be a finite number.*True"),
        ({"num_cpus": "2"}, "num_cpus must be a finite number.*'2'"),
        ({"timeout": True}, "timeout must be a finite number.*True"),
        ({"timeout": 10**400}, "timeout must be a finite number"),
        ({"max_restarts": 10**400}, "max_restarts must be an integer >= 0 and < 2"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RayVecEnv(**{"env_fns": PROBES, **arguments})


def test_no_room_in_the_cluster(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_vec_env, "PATIENCE", 0.3)
    options = {"resources": {"wind_tunnel": 1}}
    with (
        pytest.warns(UserWarning, match="still waiting for the processes of 2 of 2 environments.*'wind_tunnel': 1"),
        pytest.raises(
            TimeoutError, match=r"in 0\.6 s \(placement_timeout\) Ray did not start .*the cluster has .*'simulator': 2"
        ),
    ):
        RayVecEnv(PROBES[:2], actor_options=options, placement_timeout=0.6, **SHARED)


# ------------------------------------------------------------------- deaths


def kill(venv: RayVecEnv, index: int) -> None:
    """Kill the process of one environment."""
    pid = venv.get_attr("pid", index)[0]
    os.kill(pid, signal.SIGKILL)
    wait_until_gone(pid)


def wait_until_gone(pid: int) -> None:
    end = time.monotonic() + 60.0
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < end, "it lives on"
        time.sleep(0.01)


def test_a_death_ends_an_episode(make_mortal: Callable[..., RayVecEnv]) -> None:
    venv = make_mortal(2, max_restarts=1)
    venv.seed(40)
    venv.set_attr("knob", "turned", indices=1)
    venv.env_method("__setattr__", "dies_at", 3, indices=[1])  # not by set_attr, which would last
    first = venv.reset()
    actions = np.zeros(2, int)
    venv.step(actions)
    before = venv.step(actions)[0]
    with pytest.warns(UserWarning, match=r"environment 1 died and is restarted \(restart 1\): .*its worker process"):
        observations, rewards, dones, infos = venv.step(actions)
    # The other environment is not affected, and this one's episode is truncated at its last observation.
    assert (observations[0, 1], rewards.tolist(), dones.tolist()) == (3, [-1.0, 0.0], [False, True])
    assert infos[0] == {"TimeLimit.truncated": False}
    assert (infos[1]["TimeLimit.truncated"], infos[1]["env_restarted"]) == (True, True)
    np.testing.assert_array_equal(infos[1]["terminal_observation"], before[1])
    # The restarted environment has a new seed and all attributes that were set.
    assert observations[1, 1] == 0
    assert observations[1, 0] != first[1, 0]
    assert venv.reset_infos[1] == {"pid": venv.get_attr("pid")[1]}
    (seed,) = venv.get_attr("seeds", 1)[0]
    assert seed not in (40, 41, None)
    assert venv.get_attr("knob") == ["untouched", "turned"]
    assert venv.restarts == [0, 1]

    # A finished episode resets the count of deaths.
    assert [venv.step(actions)[2].tolist() for _ in range(10)][9] == [False, True]

    # A death between steps is noticed at the next call, and truncates the episode in the next step.
    kill(venv, 1)
    with pytest.warns(UserWarning, match="restart 2"):
        assert venv.get_attr("knob") == ["untouched", "turned"]
    (seeds,) = venv.get_attr("seeds", 1)
    assert len(seeds) == 1, "it is in an episode again"
    assert seeds != [seed], "not through the same ones"
    observations, _, dones, infos = venv.step(actions)
    assert infos[1]["env_restarted"]
    assert (dones[1], observations[1, 1]) == (True, 0)
    assert not any("env_restarted" in info for _ in range(10) for info in venv.step(actions)[3])

    # A timeout counts as death. In a reset, the restarted environment is reset in the same way.
    venv.env_method("__setattr__", "hangs", True, indices=[1])
    venv.seed(7)
    venv.timeout = 3.0
    with pytest.warns(UserWarning, match=r"restart 3.*no answer within 3 s"):
        venv.reset()
    venv.timeout = None
    assert venv.get_attr("seeds", 1) == [[8]]
    assert "env_restarted" not in venv.step(actions)[3][1]

    # Too many deaths in a row raise an error.
    with pytest.raises(RuntimeError, match=r"environment 1 has died 2 times in a row .* max_restarts is 1\. Its last"):
        venv.env_method("die", indices=[1])
    with pytest.raises(RuntimeError, match="environment 1 has died 2 times"):
        venv.step(actions)


def test_monitor_files_keep_their_rows(cluster: Cluster, tmp_path: Path) -> None:
    folder, closed = tmp_path / "monitor", tmp_path / "closed"
    venv = make_vec_env(
        MortalEnv, 1, env_kwargs={"length": 4}, monitor_dir=str(folder), vec_env_cls=RayVecEnv, vec_env_kwargs=SHARED
    )
    assert isinstance(venv, RayVecEnv)
    venv.reset()
    for _ in range(10):
        venv.step(np.zeros(1, int))
    kill(venv, 0)
    with pytest.warns(UserWarning, match="restart 1"):
        assert "episode" not in venv.step(np.zeros(1, int))[3][0]
    for _ in range(4):
        infos = venv.step(np.zeros(1, int))[3]
    assert infos[0]["episode"]["l"] == 4
    venv.env_method("set_wrapper_attr", "closed_file", closed)
    pid = venv.get_attr("pid")[0]
    venv.step_async(np.zeros(1, int))
    venv.close()
    venv.close()
    assert closed.exists(), "environments are closed"
    wait_until_gone(pid)
    assert sorted(path.name for path in folder.iterdir()) == ["0.before_restart_1.monitor.csv", "0.monitor.csv"]
    assert load_results(str(folder))["l"].tolist() == [4] * 3


class Killer(BaseCallback):
    """Kills a process and later a node, and records which episodes were truncated."""

    def __init__(self, venv: RayVecEnv, cluster: Cluster, doomed: Any) -> None:
        super().__init__()
        self.venv, self.cluster, self.doomed = venv, cluster, doomed
        self.cut_off: list[tuple[int, int]] = []

    def _on_step(self) -> bool:
        self.cut_off += [
            (self.n_calls, index) for index, info in enumerate(self.locals["infos"]) if "env_restarted" in info
        ]
        if self.n_calls == 35:
            kill(self.venv, self.venv.get_attr("node").index(self.doomed.node_id) ^ 1)
        if self.n_calls == 75:
            self.on_doomed = [node == self.doomed.node_id for node in self.venv.get_attr("node")]
            pid = self.venv.get_attr("pid", self.on_doomed.index(True))[0]
            self.cluster.remove_node(self.doomed, allow_graceful=False)
            wait_until_gone(pid)
        return True


def test_learning_survives_a_process_and_a_node(cluster: Cluster, make_mortal: Callable[..., RayVecEnv]) -> None:
    doomed = cluster.add_node(num_cpus=1, resources={"simulator": 1}, **NODE)
    cluster.wait_for_nodes()
    venv = make_mortal(2, actor_options={"resources": {"simulator": 1}})
    assert doomed.node_id in venv.get_attr("node"), "environments are spread over the machines"
    model = KNNTD(VecMonitor(venv), points=(2, 11), bounds=([-1, 0], [0, 10]), gamma=1.0, seed=0)
    killer = Killer(venv, cluster, doomed)
    with pytest.warns(UserWarning, match="is restarted"):
        model.learn(400, callback=killer)
    assert model.num_timesteps == 400
    assert sum(killer.on_doomed) == 1
    victim = killer.on_doomed.index(True)
    assert [index for _, index in killer.cut_off] == [1 - victim, victim]
    assert [call for call, _ in killer.cut_off] == [36, 76]
    assert doomed.node_id not in venv.get_attr("node")
    assert sorted(venv.restarts) == [1, 1]
    # Each step costs 1: the value is the number of remaining steps of ten.
    lengths = [info["l"] for info in model.ep_info_buffer or ()]
    assert 6 in lengths, "the episode that was cut off counts"
    assert max(lengths) == 10
    assert 380 <= sum(lengths) <= 400
    values = model.policy.q_values(th.tensor([[-0.5, 1.0], [-0.5, 8.0]])).max(dim=1).values
    assert values[0] < values[1] < 0


# --------------------------------------------------------------- Ray itself


def test_ray_is_imported_only_when_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    program = "import sys, sb3_knntd; print('ray' in sys.modules)"
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed == "False\n"
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "sb3_knntd.distributed.ray_vec_env")
    with pytest.raises(ImportError, match=r"RayVecEnv needs Ray: pip install 'sb3-knntd\[ray\]'"):
        importlib.import_module("sb3_knntd.distributed.ray_vec_env")


def test_without_a_cluster_it_starts_one(cluster: Cluster) -> None:
    program = (
        "import ray; from sb3_knntd.distributed.ray_jobs import connect; print(connect(), ray.cluster_resources())"
    )
    environ = {key: value for key, value in os.environ.items() if key != "RAY_ADDRESS"}
    done = subprocess.run([sys.executable, "-c", program], env=environ, timeout=300, capture_output=True, text=True)
    assert done.stdout.startswith("True {"), done.stderr[-3000:]
    assert "simulator" not in done.stdout


ELSEWHERE = """
import sys, warnings, os, signal, numpy as np, ray
from ray_envs import MortalEnv
from sb3_knntd.distributed.ray_vec_env import RayVecEnv
venv = RayVecEnv([MortalEnv] * 2, num_cpus=0, address=sys.argv[1])
venv.reset()
assert venv.step(np.zeros(2, int))[1].tolist() == [-1, -1]
os.kill(venv.get_attr("pid")[0], signal.SIGKILL)
infos = [venv.step(np.zeros(2, int))[3][0] for _ in range(3)]
assert sum("env_restarted" in info for info in infos) == 1, infos
try:
    venv.env_method("nothing")
except AttributeError as error:
    assert "nothing" in str(error)
venv.close()
print("done", venv.restarts)
"""


@pytest.mark.slow
def test_a_remote_cluster(cluster: Cluster) -> None:
    """Connect with Ray's client, from a program outside the cluster."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = serve("127.0.0.1", port)
    try:
        done = subprocess.run(
            [sys.executable, "-c", ELSEWHERE, f"ray://127.0.0.1:{port}"],
            env={**os.environ, "PYTHONPATH": TESTS},
            timeout=300,
            capture_output=True,
            text=True,
        )
    finally:
        server.stop(0)
    assert done.stdout.endswith("done [1, 0]\n"), done.stderr[-3000:]
