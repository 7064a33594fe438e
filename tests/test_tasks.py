import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from fgtutor.errors import ConfigError, EvaluationError, MissingExtraError, TerrainError
from fgtutor.evaluation.tasks import ATTEMPTS, Task, run_tasks

# Workers import the tasks' functions, so they live in a module of their own, on the path.
WORK = """
import os, signal, sys, time
from pathlib import Path

from fgtutor.errors import TerrainError

def square(x):
    return [{"square": x * x, "process": os.getpid()}]

def threads():
    return [{"threads": sys.modules["torch"].get_num_threads()}]

def killed_once(x, folder):
    # The first time, the worker is killed while it works, as by the out-of-memory killer.
    mark = Path(folder) / f"{x}.died"
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return square(x)

def killed(folder):
    with open(Path(folder) / "deaths", "a") as file:
        file.write("x")
    os.kill(os.getpid(), signal.SIGKILL)

def left_alone(folder):
    # Its result is no longer wanted before it is there.
    Path(folder, "worker").write_text(str(os.getpid()))
    time.sleep(600)

def resources():
    import ray
    return [ray.get_runtime_context().get_assigned_resources()]

def wrong():
    return [1 / 0]

def refused():
    raise TerrainError("unknown terrain 'moon'")
"""


@pytest.fixture
def work(tmp_path, monkeypatch):
    (tmp_path / "fgtutor_work.py").write_text(WORK)
    monkeypatch.syspath_prepend(tmp_path)
    yield __import__("fgtutor_work")
    del sys.modules["fgtutor_work"]


def squares(work, n=5):
    return [Task(name=f"t{x}", function=work.square, arguments=(x,)) for x in range(n)]


def results(tasks, **where):
    return {task.name: result for task, result in run_tasks(tasks, **where)}


@pytest.mark.parametrize("workers", [1, 2])
def test_every_task_is_done_once(work, workers):
    done = list(run_tasks(squares(work), workers=workers))
    rows = {task.name: result.rows[0] for task, result in done}
    assert len(done) == 5
    assert {name: row["square"] for name, row in rows.items()} == {f"t{x}": x * x for x in range(5)}
    here = os.getpid() in {row["process"] for row in rows.values()}
    assert here == (workers == 1)
    for _, result in done:
        assert result.seconds >= 0 and result.machine["versions"]["torch"] == torch.__version__


def test_a_task_has_one_thread_and_the_caller_keeps_its_own(work):
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        done = results([Task(name="t", function=work.threads)], workers=1)
        assert done["t"].rows == [{"threads": 1}]
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)


def test_a_killed_worker_loses_nothing(work, tmp_path):
    tasks = [
        *squares(work, 3),
        Task(name="victim", function=work.killed_once, arguments=(7, str(tmp_path))),
    ]
    done = results(tasks, workers=2)
    assert (tmp_path / "7.died").exists()
    assert done["victim"].rows[0]["square"] == 49
    assert sorted(done) == ["t0", "t1", "t2", "victim"]


@pytest.mark.slow
def test_a_task_that_always_kills_its_worker_is_named(work, tmp_path):
    tasks = [*squares(work, 1), Task(name="bad", function=work.killed, arguments=(str(tmp_path),))]
    with pytest.raises(EvaluationError, match=r"task bad .*attempt 3 of 3 \(exit code -9\)"):
        list(run_tasks(tasks, workers=2))
    assert Path(tmp_path, "deaths").read_text() == "x" * ATTEMPTS


@pytest.mark.slow
def test_workers_end_when_the_process_that_started_them_is_killed(work, tmp_path):
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import fgtutor_work as work\n"
        "from fgtutor.evaluation.tasks import Task, run_tasks\n"
        "tasks = [Task(name='a', function=work.left_alone, arguments=(sys.argv[1],)),\n"
        "         Task(name='b', function=work.square, arguments=(2,))]\n"
        "if __name__ == '__main__': list(run_tasks(tasks, workers=2))"
    )
    script = tmp_path / "asks.py"
    script.write_text(code)
    asks = subprocess.Popen([sys.executable, str(script), str(tmp_path)])
    started = tmp_path / "worker"
    assert eventually(lambda: started.exists() and started.read_text())
    worker = int(started.read_text())
    asks.kill()
    asks.wait()
    assert eventually(lambda: not alive(worker))


@pytest.mark.slow
def test_workers_end_at_once_when_the_caller_stops(work, tmp_path):
    tasks = [
        Task(name="a", function=work.left_alone, arguments=(str(tmp_path),)),
        *squares(work, 1),
    ]
    running = run_tasks(tasks, workers=2)
    next(running)
    assert eventually(lambda: (tmp_path / "worker").exists() and (tmp_path / "worker").read_text())
    running.close()  # as Ctrl-C does
    assert not alive(int((tmp_path / "worker").read_text()))


@pytest.mark.slow
def test_workers_that_cannot_start_are_an_error(work, tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import fgtutor_work as work\n"
        "from fgtutor.evaluation.tasks import Task, run_tasks\n"
        "tasks = [Task(name=f't{i}', function=work.square, arguments=(i,)) for i in range(3)]\n"
        "list(run_tasks(tasks, workers=2))"  # every worker imports this and would start its own
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "EvaluationError: task t" in done.stderr


def eventually(condition, seconds=60):
    """Tell whether a condition comes true in time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.05)
    return False


def alive(process):
    """Tell whether a process is there, and not only waiting to be buried."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{process}/stat")  # on Linux
    return not (state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z")


@pytest.mark.parametrize("workers", [1, 2])
def test_what_a_task_raises_reaches_the_caller(work, workers):
    refused = [Task(name="a", function=work.refused), Task(name="b", function=work.refused)]
    with pytest.raises(TerrainError, match="moon"):
        list(run_tasks(refused, workers=workers))
    wrong = [Task(name="a", function=work.wrong), Task(name="b", function=work.wrong)]
    with pytest.raises(EvaluationError, match=r"(?s)task [ab] failed.*1 / 0.*ZeroDivisionError"):
        list(run_tasks(wrong, workers=workers))


def test_no_task_is_no_work():
    assert results([]) == {}


def test_a_missing_ray_says_what_to_install(work, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    with pytest.raises(MissingExtraError, match=r'pip install .* -e "\.\[cluster\]"'):
        results(squares(work), ray="auto")


@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_ray_gives_the_same_and_survives_a_killed_worker(work, tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="the extra [cluster] is not installed")
    # A local cluster's workers find modules through this variable only.
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # or it writes a token into the home folder
    tasks = [
        *squares(work, 3),
        Task(name="victim", function=work.killed_once, arguments=(7, str(tmp_path))),
    ]
    done = results(tasks, ray="local")
    assert {name: result.rows[0]["square"] for name, result in done.items()} == {
        "t0": 0,
        "t1": 1,
        "t2": 4,
        "victim": 49,
    }
    with pytest.raises(TerrainError, match="moon"):
        results([Task(name="a", function=work.refused)], ray="local")
    cores = os.cpu_count()
    everything = Task(name="everything", function=work.resources, cores=cores)
    assert results([everything], ray="local")["everything"].rows == [{"CPU": cores}]
    with pytest.raises(ConfigError, match=r"task a takes 1 cores and 1000 GPUs, more than any"):
        results([Task(name="a", function=work.resources, gpus=1000)], ray="local")
    with pytest.raises(ConfigError, match="no Ray cluster answers"):
        results(squares(work), ray="auto")  # the local one has ended
