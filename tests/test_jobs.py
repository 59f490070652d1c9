"""Jobs: each is computed once, even if other jobs, their processes or the program fail."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import job_functions
import pytest

from sb3_knntd.common.files import replace_file
from sb3_knntd.distributed import jobs as jobs_module
from sb3_knntd.distributed.jobs import Job, Outcome, compute, run_jobs, stored_as

INTERRUPTIBLE = """
import sys
from pathlib import Path
import job_functions
from sb3_knntd.distributed.jobs import Job, run_jobs
if __name__ == "__main__":
    folder, pids, seconds = Path(sys.argv[1]), sys.argv[2], float(sys.argv[3])
    jobs = [Job("quick", job_functions.slow, {"seconds": 0, "folder": pids}),
            Job("slow", job_functions.slow, {"seconds": seconds, "folder": pids})]
    try:
        run_jobs(jobs, folder, workers=1)
    except KeyboardInterrupt:
        sys.exit(130)
"""


def squares(numbers: list[int], log: Path) -> list[Job]:
    return [Job(f"square-{n}", job_functions.square, {"number": n, "log": str(log)}) for n in numbers]


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    """Whether a process is running; zombies do not count."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_results_stay_computed_when_their_function_moves(tmp_path: Path) -> None:
    log = tmp_path / "log"
    run_jobs(squares([3], log), tmp_path / "jobs")

    def moved(number: int, log: str) -> None:
        raise AssertionError("it is there")

    job = squares([3], log)[0]._replace(function=stored_as("job_functions.square")(moved))
    assert run_jobs([job], tmp_path / "jobs")[job.key] == Outcome({"square": 9, "pair": [3, 3]})
    renamed = job._replace(function=stored_as("other_functions.square", "job_functions.square")(moved))
    assert run_jobs([renamed], tmp_path / "jobs")[job.key] == Outcome({"square": 9, "pair": [3, 3]})
    with pytest.raises(ValueError, match=r"wait_until must be decorated with stored_as\(name\)"):
        run_jobs([Job("a", wait_until, {})], tmp_path / "jobs")


def test_each_is_computed_once_for_its_arguments(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder, log = tmp_path / "new" / "jobs", tmp_path / "log"
    outcomes = run_jobs(squares([3, 1, 2], log), folder, workers=2, title="squares")
    assert list(outcomes) == ["square-3", "square-1", "square-2"]
    assert outcomes["square-3"] == Outcome({"square": 9, "pair": [3, 3]})
    assert sorted(log.read_text().split()) == ["1", "2", "3"]
    assert json.loads((folder / "square-3.json").read_text()) == {
        "function": "job_functions.square",
        "arguments": {"number": 3, "log": str(log)},
        "result": {"square": 9, "pair": [3, 3]},
    }
    # Not on a terminal: lines with the number of jobs and the remaining time.
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == [f"squares: {n} of 3" for n in (1, 2, 3)]
    assert all(line.endswith("left") for line in lines)

    # Other arguments, a damaged file, another function, a failed job: all must be computed again.
    jobs = squares([3, 1, 2, 4], log)
    jobs[0] = jobs[0]._replace(arguments={"number": 5, "log": str(log)})
    (folder / "square-1.json").write_bytes((folder / "square-1.json").read_bytes()[:-9])
    stored = json.loads((folder / "square-2.json").read_text())
    (folder / "square-2.json").write_text(json.dumps(stored | {"function": "job_functions.cube"}))
    (folder / "square-4.json").write_text(json.dumps({"function": "job_functions.square", "error": "some reason"}))
    log.unlink()
    outcomes = run_jobs(jobs, folder, workers=1)
    assert outcomes["square-3"].result["square"] == 25
    assert log.read_text().split() == ["5", "1", "2", "4"]
    log.unlink()
    assert run_jobs(jobs, folder) == outcomes
    assert not log.exists()
    assert sorted(path.name for path in folder.glob("*.json")) == [f"square-{n}.json" for n in (1, 2, 3, 4)]


def test_failing_and_dying_jobs_do_not_affect_the_others(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    jobs = [
        Job("once", job_functions.die, {"marker": str(tmp_path / "once"), "times": 1}),
        Job("always", job_functions.die, {"marker": str(tmp_path / "always"), "times": 99}),
        Job("raises", job_functions.fail, {"what": "such thing"}),
        Job("unstorable", job_functions.unstorable, {}),
        *squares([6, 7], tmp_path / "log"),
        Job("threads", job_functions.threads, {}),
    ]
    outcomes = run_jobs(jobs, tmp_path / "jobs", workers=2)
    assert list(outcomes) == [job.key for job in jobs]
    assert outcomes["once"] == Outcome("alive after 1")
    assert "died 2 times" in outcomes["always"].error
    assert (tmp_path / "always").read_text() == "2"
    assert outcomes["raises"].error.startswith("Traceback")
    assert "ValueError: there is no such thing" in outcomes["raises"].error
    assert "in fail" in outcomes["raises"].error, "the traceback does not say where"
    assert "TypeError" in outcomes["unstorable"].error
    assert [outcomes[f"square-{n}"].result["square"] for n in (6, 7)] == [36, 49]
    assert (tmp_path / "log").read_text().split() in (["6", "7"], ["7", "6"]), "a bystander was computed twice"
    assert capfd.readouterr().err.splitlines()[-1].startswith(": 7 of 7, 3 failed")

    alone = outcomes["threads"].result
    assert (alone["torch"], alone["openmp"]) == (1, "1")
    assert alone["process"] != os.getpid()
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ

    assert "ValueError" in json.loads((tmp_path / "jobs" / "raises.json").read_text())["error"]


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("blow", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_jobs_keep_results_and_continue(tmp_path: Path, blow: signal.Signals) -> None:
    folder, pids, script = tmp_path / "jobs", tmp_path / "pids", tmp_path / "script.py"
    pids.mkdir()
    script.write_text(INTERRUPTIBLE)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, str(script), str(folder), str(pids)]
    program = subprocess.Popen([*command, "60"], env=environment, start_new_session=True)
    # The single worker starts the slow job when the result of the fast one is, or is about to be, on disk.
    wait_until(lambda: (folder / "quick.json").exists())
    time.sleep(0.2)
    if blow == signal.SIGINT:
        os.killpg(program.pid, blow)  # like a terminal
    else:
        os.kill(program.pid, blow)
    assert program.wait(20) == (130 if blow == signal.SIGINT else -blow)
    (worker,) = (int(path.name.split("-")[1]) for path in pids.iterdir())
    wait_until(lambda: not is_running(worker), 5)
    assert [path.name for path in folder.glob("*.json")] == ["quick.json"]

    if blow == signal.SIGINT:
        first = (folder / "quick.json").read_text()
        assert subprocess.run([*command, "0"], env=environment, timeout=60, check=False).returncode == 0
        assert (folder / "quick.json").read_text() == first
        assert json.loads((folder / "slow.json").read_text())["result"] != worker


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="cannot start a process that has signals blocked")
def test_ctrl_c_waits_until_a_process_is_started() -> None:
    """Otherwise any thread may receive the signal, and a process could be started with incomplete data."""
    program = "import signal; print(signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
    blocked = []

    def interrupted_start() -> None:
        with jobs_module._interrupts_held():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)
            blocked.append(subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True).stdout)

    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted_start()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, handler)
        done.set()
        other.join()
    assert len(blocked) == 1
    assert b"SIGINT" in blocked[0]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize("key", ["", "a/b", "..", ".hidden", "a b"])
def test_a_key_must_be_a_file_name(key: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a key must be"):
        run_jobs([Job(key, job_functions.unstorable, {})], tmp_path / "jobs")
    assert not (tmp_path / "jobs").exists()


def test_invalid_arguments_are_refused(tmp_path: Path) -> None:
    job = Job("a", job_functions.unstorable, {})
    with pytest.raises(ValueError, match="keys must differ"):
        run_jobs([job, job], tmp_path)
    with pytest.raises(ValueError, match="workers must be at least 1; got 0"):
        run_jobs([job], tmp_path, workers=0)
    with pytest.raises(TypeError):
        run_jobs([job._replace(arguments={"x": object()})], tmp_path)
    assert not list(tmp_path.iterdir())


def test_no_jobs(tmp_path: Path) -> None:
    assert run_jobs([], tmp_path / "jobs") == {}


def test_a_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "file"
    replace_file(path, b"old")
    with pytest.raises(TypeError):
        replace_file(path, "no bytes")  # type: ignore[arg-type]
    assert path.read_bytes() == b"old"
    replace_file(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_second_process_in_the_folder_says_so_and_computes_nothing(tmp_path: Path) -> None:
    folder, pids, script = tmp_path / "jobs", tmp_path / "pids", tmp_path / "script.py"
    pids.mkdir()
    script.write_text(INTERRUPTIBLE)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    program = subprocess.Popen([sys.executable, str(script), str(folder), str(pids), "60"], env=environment)
    try:
        wait_until(lambda: (folder / "quick.json").exists())
        with pytest.raises(BlockingIOError, match="another process computes in"):
            run_jobs(squares([3], tmp_path / "log"), folder)
        assert not (tmp_path / "log").exists()
    finally:
        program.kill()
        program.wait()
    # The lock of a killed process is released.
    assert run_jobs(squares([3], tmp_path / "log"), folder, workers=1)["square-3"].result["square"] == 9


@pytest.mark.parametrize(
    "content", [b"[]", b"{", b'{"result": 3}', b"[" * 100_000], ids=["list", "cut", "alone", "deep"]
)
def test_a_damaged_file_is_named_and_its_job_repeated(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], content: bytes
) -> None:
    jobs = squares([3], tmp_path / "log")
    run_jobs(jobs, tmp_path / "jobs", workers=1)
    path = tmp_path / "jobs" / "square-3.json"
    path.write_bytes(content)
    capfd.readouterr()
    assert run_jobs(jobs, tmp_path / "jobs", workers=1)["square-3"].result["square"] == 9
    told = capfd.readouterr().err
    assert (f"{path} is damaged" in told) == (content != b'{"result": 3}'), "of another job is not damaged"


def test_an_invalid_result_is_named_and_its_job_repeated(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    jobs = [job._replace(fits=lambda result: "square" in result) for job in squares([3], tmp_path / "log")]
    folder = tmp_path / "jobs"
    run_jobs([job._replace(fits=None) for job in jobs], folder, workers=1)
    stored = json.loads((folder / "square-3.json").read_text())
    (folder / "square-3.json").write_text(json.dumps(stored | {"result": {"cube": 27}}))
    capfd.readouterr()
    outcomes = run_jobs(jobs, folder, backend=lambda missing: ((job, compute(job)) for job in missing))
    assert outcomes["square-3"].result["square"] == 9
    assert "square-3.json is damaged" in capfd.readouterr().err


DYING = """
import sys
from pathlib import Path

import job_functions
from sb3_knntd.distributed.jobs import Job, run_jobs

if __name__ == "__main__":
    job = Job("dies", job_functions.die_while_answering, {"marker": sys.argv[1] + "/marker", "times": int(sys.argv[2])})
    print(run_jobs([job], Path(sys.argv[1]) / "jobs", workers=1)["dies"].error or "alive")
"""


@pytest.mark.parametrize(("times", "said"), [(1, "alive"), (9, "its process died 2 times: killed, or short of memory")])
def test_a_worker_that_dies_while_sending_a_large_result_does_not_block(tmp_path: Path, times: int, said: str) -> None:
    # As workers did at Ctrl-C: the reader of the other half would wait forever.
    script = tmp_path / "script.py"
    script.write_text(DYING)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, str(script), str(tmp_path), str(times)]
    program = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        assert program.communicate(timeout=100)[0].strip() == said
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(program.pid, signal.SIGKILL)
