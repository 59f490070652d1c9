"""Configurations of a comparison are data: no code in them is run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")

import rl_zoo3
import yaml
from stable_baselines3 import HerReplayBuffer
from torch import nn

from sb3_knntd.cli import main
from sb3_knntd.experiments.compare.expressions import EXPRESSIONS, as_data, evaluate
from sb3_knntd.experiments.compare.run import is_result


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("dict(net_arch=[400, 300])", {"net_arch": [400, 300]}),
        ("dict(log_std_init=-2,\n activation_fn=nn.ReLU, net_arch=dict(pi=[64]))", None),
        ("{'norm_obs': True, 'norm_reward': False}", {"norm_obs": True, "norm_reward": False}),
        ("(1, -2.5, 'word', None)", (1, -2.5, "word", None)),
        ("HerReplayBuffer", HerReplayBuffer),
    ],
)
def test_allowed_expressions_are_evaluated(expression: str, value: Any) -> None:
    found = evaluate("policy_kwargs", expression)
    expected = value or {"log_std_init": -2, "activation_fn": nn.ReLU, "net_arch": {"pi": [64]}}
    assert found == expected


def test_all_configurations_of_rl_zoo_are_read() -> None:
    n_read = 0
    for path in (Path(rl_zoo3.__file__).parent / "hyperparams").glob("*.yml"):
        for hyperparams in yaml.safe_load(path.read_text()).values():
            for name in EXPRESSIONS:
                if isinstance(hyperparams.get(name), str):
                    evaluate(name, hyperparams[name])
                    n_read += 1
    assert n_read > 50


@pytest.mark.parametrize(
    "expression",
    [
        "__import__('os').system('touch mark')",
        "dict(**{'a': 1})",
        "dict(a=open('mark', 'w'))",
        "[x for x in (1, 2)]",
        "nn.Module.__subclasses__",
        "nn.functional",
        "nn.init",
        "lambda: 0",
        "HerReplayBuffer()",
        "dict(",
        "(" * 500,
    ],
)
def test_anything_else_is_refused(expression: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="policy_kwargs must be literals"):
        as_data({"policy_kwargs": expression})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "hyperparams",
    [
        {"callback": {"subprocess.Popen": {"args": "touch mark", "shell": True}}},
        {"callback": ["os.system"]},
        {"env_wrapper": [{"builtins.print": {}}]},
        {"vec_env_wrapper": "gymnasium.Wrapper"},
        {"env_wrapper": "mine.Wrapper"},
        {"policy": "os.system"},
    ],
)
def test_classes_must_have_the_required_base(
    hyperparams: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text("open('mark', 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="in a package that is imported"):
        as_data(hyperparams)
    assert not (tmp_path / "mark").exists()
    assert as_data({"env_wrapper": "gymnasium.wrappers.FlattenObservation", "policy": "MlpPolicy"})


def test_the_command_refuses_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("dqn.yml").write_text("default: {policy: MlpPolicy, policy_kwargs: \"dict(a=open('mark', 'w'))\"}")
    with pytest.raises(SystemExit, match="2"):
        main(["compare", "--env", "CartPole-v1", "--algos", "dqn", "--conf", "dqn=dqn.yml", "--out", "out"])
    told = capsys.readouterr().err.strip()
    assert "policy_kwargs must be literals" in told
    assert "Traceback" not in told
    assert not Path("mark").exists()


RESULT: dict[str, Any] = {
    **{name: [1.0, 2.0] for name in ("steps", "returns", "stds", "seconds")},
    **dict.fromkeys(("cpu_seconds", "start_seconds", "base_memory", "peak_memory", "model_size"), 1.0),
    "versions": {"python": "3"},
    "machine": {"processor": "p", "cores": "2", "system": "s"},
}


@pytest.mark.parametrize(
    "change",
    [
        {"returns": [1.0]},
        {"returns": []},
        {"steps": ["a", "b"]},
        {"seconds": [0.0, 1.0]},
        {"cpu_seconds": None},
        {"machine": {}},
        {"versions": [1]},
    ],
)
def test_invalid_results_are_detected(change: dict[str, Any]) -> None:
    assert is_result(RESULT)
    assert not is_result({**RESULT, **change})
    for name in RESULT:
        assert not is_result({key: value for key, value in RESULT.items() if key != name})
    assert not is_result([])
