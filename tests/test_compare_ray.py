"""Jobs and comparisons on a Ray cluster of several local nodes, one of which dies."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import job_functions
import pytest
import ray
from ray.cluster_utils import Cluster
from ray.util.client.server.server import serve
from ray_cluster import NODE, TESTS, loopback_cluster

from sb3_knntd.cli import main
from sb3_knntd.distributed.jobs import Job, run_jobs
from sb3_knntd.distributed.ray_jobs import connected, run_on_ray


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """A cluster of a head without CPUs and one node; this process is connected to it."""
    with loopback_cluster(num_cpus=1) as made:
        yield made


def wait_until(condition: Any, seconds: float = 90.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.05)


def test_jobs_of_a_dead_node_are_repeated(cluster: Cluster, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pids = tmp_path / "pids"
    pids.mkdir()
    doomed = cluster.add_node(num_cpus=1, **NODE)
    jobs = [
        *(Job(f"slow-{n}", job_functions.slow, {"seconds": 3, "folder": str(pids)}) for n in range(2)),
        Job("raises", job_functions.fail, {"what": "such thing"}),
        Job("threads", job_functions.threads, {}),
    ]

    def kill() -> None:
        wait_until(lambda: len(list(pids.iterdir())) == 2)
        cluster.remove_node(doomed, allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    outcomes = run_jobs(jobs, tmp_path / "jobs", title="t", backend=run_on_ray)
    killer.join()

    begun = {int(path.name.split("-")[1]) for path in pids.iterdir()}
    ended = {outcomes[f"slow-{n}"].result for n in range(2)}
    assert len(begun) == 3, "no job was begun again"
    assert len(ended) == 2
    assert ended < begun
    assert "ValueError: there is no such thing" in outcomes["raises"].error
    alone = outcomes["threads"].result
    assert (alone["torch"], alone["openmp"]) == (1, "1")
    assert alone["process"] not in {*begun, os.getpid()}
    # Each was reported once, and stored.
    err = capfd.readouterr().err
    assert [f"t: {n} of 4" in err for n in range(1, 6)] == [True] * 4 + [False]
    stored = {path.stem: json.loads(path.read_bytes()) for path in (tmp_path / "jobs").glob("*.json")}
    assert {key: content.get("result") for key, content in stored.items()} == {
        key: outcome.result for key, outcome in outcomes.items()
    }


def test_the_backend_does_not_change_what_is_learned(cluster: Cluster, tmp_path: Path) -> None:
    arguments = ["compare", "--env", "compare/Corridor-v0", "--algos", "knntd", "--seeds", "1", "--steps", "300"]
    arguments += ["--eval-points", "3", "--eval-episodes", "2", "--gym-packages", "compare_envs"]
    assert main([*arguments, "--backend", "ray", "--out", str(tmp_path / "ray")]) == 0
    assert main([*arguments, "--out", str(tmp_path / "local")]) == 0
    names = sorted(path.name for path in (tmp_path / "ray" / "runs").glob("*.json"))
    assert names == sorted(path.name for path in (tmp_path / "local" / "runs").glob("*.json"))
    assert len(names) == 2
    for name in names:
        there, here = (json.loads((tmp_path / where / "runs" / name).read_bytes()) for where in ("ray", "local"))
        assert there["arguments"] == here["arguments"]
        for what in ("steps", "returns", "stds", "versions"):
            assert there["result"][what] == here["result"][what]
    # One backend continues with the results of the other.
    before = {name: (tmp_path / "ray" / "runs" / name).stat().st_mtime_ns for name in names}
    assert main([*arguments, "--out", str(tmp_path / "ray")]) == 0
    assert before == {name: (tmp_path / "ray" / "runs" / name).stat().st_mtime_ns for name in names}


@pytest.mark.slow
def test_a_remote_cluster(cluster: Cluster, tmp_path: Path) -> None:
    """Connect with Ray's client, from a program outside the cluster."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = serve("127.0.0.1", port)
    program = "import sys; from sb3_knntd.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "compare", "--env", "compare/Corridor-v0", "--algos", "random"]
    command += ["--seeds", "2", "--steps", "300", "--eval-points", "3", "--eval-episodes", "2"]
    command += ["--gym-packages", "compare_envs", "--backend", "ray", "--address", f"ray://127.0.0.1:{port}"]
    try:
        subprocess.run(
            [*command, "--out", str(tmp_path)], env={**os.environ, "PYTHONPATH": TESTS}, timeout=300, check=True
        )
    finally:
        server.stop(0)
    assert len(list((tmp_path / "runs").glob("*.json"))) == 2
    assert (tmp_path / "report.html").exists()


def test_interrupting_stops_the_jobs(cluster: Cluster, tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    pids.mkdir()
    events = run_on_ray([Job("slow", job_functions.slow, {"seconds": 600, "folder": str(pids)})])
    assert next(events)[1] is None
    wait_until(lambda: list(pids.iterdir()))
    events.close()
    (path,) = pids.iterdir()
    wait_until(lambda: not Path(f"/proc/{path.name.split('-')[1]}").exists())


def test_a_missing_cluster_is_reported(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with connected("ray://127.0.0.1:1"):
        assert ray.is_initialized(), "whoever is connected stays so"
    monkeypatch.setattr(ray, "is_initialized", lambda: False)

    def refuse(address: str, **options: Any) -> None:
        raise ConnectionError(f"no cluster at {address}")

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(SystemExit, match="2"):
        main(
            ["compare", "--env", "CartPole-v1", "--algos", "knntd", "--backend", "ray", "--address", "ray://nowhere:1"]
        )
    assert "--address: no cluster at ray://nowhere:1" in capsys.readouterr().err
