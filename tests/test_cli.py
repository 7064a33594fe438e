"""The command line: overview, errors as messages, lazy imports, options from the dataclasses."""

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

import fgtutor
from fgtutor import __main__ as cli
from fgtutor.cli.doctor import DoctorConfig
from fgtutor.errors import MapError


def fresh(code: str) -> str:
    """Run code in a new interpreter and return what it printed."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.parametrize("words", [["--help"], ["-h"], [], ["evaluate", "--help"]])
def test_help_lists_every_command(capsys, words):
    assert cli.main(words) == 0
    output = capsys.readouterr().out
    assert all(command in output and what in output for command, (*_, what) in cli.COMMANDS.items())


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == fgtutor.__version__


@pytest.mark.parametrize("words", [["fly"], ["evaluate"], ["evaluate", "everything"], ["--robot"]])
def test_an_unknown_command_lists_the_known_ones(capsys, words):
    assert cli.main(words) == cli.USAGE
    error = capsys.readouterr().err
    assert repr(" ".join(words)) in error and "evaluate matrix" in error


@pytest.mark.parametrize("module", ["torch", "mujoco", "pymunk", "matplotlib", "tyro", "IPython"])
def test_the_package_and_its_help_load_nothing_heavy(module):
    code = (
        "import sys, fgtutor, fgtutor.__main__ as cli; cli.main(['--help'])\n"
        f"print({module!r} in sys.modules)"
    )
    assert fresh(code).endswith("False")


@pytest.mark.slow
def test_the_spine_loads_no_simulator_and_no_notebook():
    code = (
        "import sys, fgtutor\n"
        "[getattr(fgtutor, name) for name in ('ElevationMap', 'make_terrain', 'load_zoo')]\n"
        "print({'mujoco', 'pymunk', 'matplotlib', 'IPython', 'git'} & set(sys.modules))"
    )
    assert fresh(code) == "set()"


@pytest.mark.slow
def test_what_the_workers_of_an_evaluation_import_loads_nothing_to_draw_with():
    modules = {module for module, _, _ in cli.COMMANDS.values() if module.startswith("evaluation")}
    code = f"import sys, importlib\nfor name in {sorted(modules)}:\n"
    code += "    importlib.import_module('fgtutor.' + name)\n"
    assert fresh(f"{code}print({{'matplotlib', 'scipy.stats'}} & set(sys.modules))") == "set()"


@pytest.mark.slow
def test_planning_and_driving_do_not_wait_for_torchs_compiler():
    modules = {module for module, _, _ in cli.COMMANDS.values()}
    code = f"import sys, importlib\nfor name in {sorted(modules)}:\n"
    code += "    importlib.import_module('fgtutor.' + name)\n"
    code += (
        "from fgtutor import execute, load_zoo, make_terrain, plan_on_map\n"
        "zoo, ground = load_zoo('toy'), make_terrain('steps', robot='toy')\n"
        "route = plan_on_map(ground.elevation, zoo, ground.start, ground.goal).route\n"
        "assert execute(route, ground, zoo).seconds > 1\n"
        "print({'torch._dynamo', 'sympy'} & set(sys.modules))"
    )
    assert fresh(code) == "set()"


def test_a_name_that_is_not_offered_is_an_attribute_error():
    with pytest.raises(AttributeError, match="'teleport'"):
        _ = fgtutor.teleport
    assert set(fgtutor.__all__) <= set(dir(fgtutor))
    assert fgtutor._HOMES.keys() | {"errors", "__version__"} == set(fgtutor.__all__)


def test_a_lazy_name_is_the_object_of_its_module():
    from fgtutor.specialist import load_zoo

    assert fgtutor.load_zoo is load_zoo


@pytest.mark.parametrize(
    ("raised", "code", "message"),
    [
        (MapError("the map is empty: give another"), cli.USAGE, "fgtutor doctor: the map is empty"),
        (KeyboardInterrupt(), cli.INTERRUPTED, "interrupted"),
    ],
)
def test_what_a_command_raises_becomes_a_message(capsys, monkeypatch, raised, code, message):
    def run(config):
        raise raised

    monkeypatch.setattr("fgtutor.cli.doctor.run", run)
    assert cli.main(["doctor"]) == code
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error


@pytest.mark.parametrize(("returned", "code"), [(None, 0), (0, 0), (1, 1)])
def test_the_exit_code_is_what_the_command_returns(monkeypatch, returned, code):
    monkeypatch.setattr("fgtutor.cli.doctor.run", lambda config: returned)
    assert cli.main(["doctor"]) == code


def test_options_reach_the_dataclass(monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr("fgtutor.cli.doctor.run", seen.append)
    assert cli.main(["doctor", "--zoo", str(tmp_path), "--no-gl", "--gl-seconds", "5"]) == 0
    assert seen == [DoctorConfig(zoo=tmp_path, gl=False, gl_seconds=5.0)]


@pytest.mark.parametrize("options", [["--cheese"], ["--gl-seconds", "soon"]])
def test_a_wrong_option_is_a_usage_error(capsys, options):
    with pytest.raises(SystemExit) as stop:
        cli.main(["doctor", *options])
    assert stop.value.code == cli.USAGE
    assert options[0] in capsys.readouterr().err


def test_a_commands_help_shows_its_fields(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["doctor", "--help"])
    output = capsys.readouterr().out
    assert not stop.value.code
    assert "Folder of the zoo" in output and "--gl-seconds" in output


def test_the_module_runs_as_a_program():
    environment = os.environ | {"PYTHONWARNINGS": "error"}
    done = subprocess.run(
        [sys.executable, "-m", "fgtutor", "nonsense"],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert done.returncode == cli.USAGE and "nonsense" in done.stderr and not done.stdout


NAMESAKES = (
    *("random", "socket", "pickle", "tempfile", "json", "logging", "subprocess", "signal"),
    *("numpy", "torch", "mujoco", "scipy", "laspy", "fgtutor", "sitecustomize", "site"),
)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="the program lies elsewhere on Windows")
def test_no_command_runs_code_of_the_current_folder(tmp_path, zoo):
    for name in NAMESAKES:
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r} + chr(10))"
        )
    (tmp_path / "c.xyz").write_text("0.01 0.01 0\n0.02 0.02 0\n")
    program = Path(sys.executable).with_name("fgtutor")
    evaluation = ["--terrains", "flat", "--policies", "steps", "--protocol", "paper", "--trials", 2]
    for words in (
        ["doctor", "--zoo", zoo.parent, "--no-gl"],  # drawing has its own test below
        ["evaluate", "matrix", "--zoo", zoo, *evaluation, "--workers", 2],
        ["map", "c.xyz", "--out", "m.npz"],
        ["export", zoo / "steps"],
    ):
        done = subprocess.run(
            [program, *map(str, words)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert "Traceback" not in done.stderr, done.stderr
        assert not (tmp_path / "ran").exists(), (words, (tmp_path / "ran").read_text())


@pytest.mark.slow
def test_drawing_runs_no_code_of_the_current_folder(tmp_path, monkeypatch):
    import mujoco

    from fgtutor.errors import RenderingError
    from fgtutor.robots.offscreen import Renderer

    (tmp_path / "mujoco.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    with suppress(RenderingError), Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8):
        pass
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_a_closed_pipe_is_no_error_and_costs_no_map(tmp_path):
    (tmp_path / "c.xyz").write_text("0.01 0.01 0\n0.02 0.02 0\n")
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "fgtutor", "map", "c.xyz", "--out", "m.npz"],
        cwd=tmp_path,
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(write)
    assert done.returncode == cli.UNREAD
    assert done.stderr == "" and (tmp_path / "m.npz").exists()


def test_a_package_that_is_not_installed_gives_one_line(capsys, monkeypatch):
    def absent(name):
        raise ModuleNotFoundError("No module named 'jupytext'", name="jupytext")

    monkeypatch.setattr("importlib.import_module", absent)
    assert cli.main(["notebooks"]) == cli.USAGE
    assert "the package jupytext is not installed; " in capsys.readouterr().err
