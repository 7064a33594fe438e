"""The doctor's findings on this machine, and on broken ones made for it."""

import importlib
import importlib.metadata

import pytest

from fgtutor.cli import doctor
from fgtutor.cli.doctor import DoctorConfig, Finding
from fgtutor.specialist import save_specialist


def findings(zoo, **settings) -> dict[str, Finding]:
    config = DoctorConfig(zoo=zoo, gl=False, **settings)
    return {finding.what: finding for finding in doctor.examine(config)}


@pytest.fixture
def zoo(make_specialist, tmp_path):
    save_specialist(make_specialist(), tmp_path / "zoo" / "toy" / "steps")
    return tmp_path / "zoo"


def test_a_sound_installation_has_nothing_broken(zoo, capsys):
    assert doctor.run(DoctorConfig(zoo=zoo, gl=False)) == 0
    output = capsys.readouterr().out
    assert "BROKEN" not in output
    for what in ("python", "torch", "pymunk", "gpu", "cores", "memory", "disk", "zoo toy/steps"):
        assert what in output


def test_versions_are_those_installed(zoo):
    value = findings(zoo)["packages"].value
    for name in ("torch", "mujoco", "pymunk", "rsl-rl-lib"):
        assert f"{name} {importlib.metadata.version(name)}" in value


def test_a_corrupt_specialist_is_broken_and_named(zoo, capsys):
    file = zoo / "toy" / "steps" / "policy.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    finding = findings(zoo)["zoo toy/steps"]
    assert finding.state == "broken" and str(file) in finding.fix
    assert doctor.run(DoctorConfig(zoo=zoo, gl=False)) == 1
    assert "BROKEN  zoo toy/steps" in capsys.readouterr().out


def test_a_half_written_folder_is_passed_over(zoo):
    (zoo / "toy" / "steps").rename(zoo / "toy" / ".steps.0000.old")
    assert findings(zoo)["zoo"].state == "broken"


@pytest.mark.parametrize("folder", ["empty", "absent"])
def test_an_empty_zoo_is_broken(tmp_path, folder):
    (tmp_path / "empty").mkdir()
    finding = findings(tmp_path / folder)["zoo"]
    assert finding.state == "broken" and str(tmp_path / folder) in finding.value


@pytest.mark.parametrize(
    ("names", "what", "state"),
    [
        (("pymunk",), "packages", "broken"),
        (("jupyterlab", "nbclient"), "extra lab", "note"),
        (("ray",), "extra cluster", "note"),
    ],
)
def test_what_is_not_installed_has_one_line_and_one_remedy(
    zoo, monkeypatch, capsys, names, what, state
):
    installed = importlib.metadata.version

    def version(package):
        if package in names:
            raise importlib.metadata.PackageNotFoundError(package)
        return installed(package)

    monkeypatch.setattr(importlib.metadata, "version", version)
    finding = findings(zoo)[what]
    assert finding.state == state and "pip install" in finding.fix
    lines = doctor.report(list(findings(zoo).values())).splitlines()
    assert len([line for line in lines if what in line]) == 2


def test_a_torch_that_does_not_load_still_gets_a_report(zoo, monkeypatch):
    real = importlib.import_module

    def broken(name):
        if name in ("torch", "fgtutor.specialist"):
            raise OSError("loading\nlibtorch_cpu.so: wrong ELF class")
        return real(name)

    monkeypatch.setattr(importlib, "import_module", broken)
    found = findings(zoo)
    assert found["import torch"].state == found["zoo"].state == "broken"
    assert found["import torch"].value == "libtorch_cpu.so: wrong ELF class"
    assert "disk" in found


@pytest.mark.parametrize(("limit", "what"), [("LOW_DISK", "disk"), ("LOW_MEMORY", "memory")])
def test_a_small_machine_gets_a_note(zoo, monkeypatch, limit, what):
    monkeypatch.setattr(doctor, limit, 1e9)
    assert findings(zoo)[what].state == "note" and findings(zoo)[what].fix


def test_a_gl_backend_that_does_not_exist_is_named_with_a_reason(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "crayons")
    [finding] = [f for f in doctor.examine(DoctorConfig(gl_seconds=60)) if f.what == "gl"]
    assert finding.state == "note" and "crayons" in finding.value and "MUJOCO_GL" in finding.fix


@pytest.mark.slow
def test_a_gl_backend_that_hangs_is_given_up(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    [finding] = [f for f in doctor.examine(DoctorConfig(gl_seconds=1e-3)) if f.what == "gl"]
    assert finding.state == "note" and "no picture within 0.001 s" in finding.value


def test_the_table_lines_up_and_lists_what_to_do():
    rows = [
        Finding(what="a", value="1"),
        Finding(what="long name", value="2", state="note", fix="mend it"),
    ]
    assert doctor.report(rows).splitlines() == [
        "ok      a          1",
        "note    long name  2",
        "",
        "What to do:",
        "- long name: mend it",
    ]
    assert doctor.report(rows[:1]).endswith("Nothing to do.")
