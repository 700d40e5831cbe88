"""The command line's promises: fast help, one line for a user's mistake, exit statuses."""

import errno
import subprocess
import sys
from types import ModuleType

import pytest
import typer
from typer.testing import CliRunner

from lodelight.cli import main as cli
from lodelight.cli.progress import track
from lodelight.errors import MapError, RunError


def add_command(monkeypatch, body):
    """Register `lodelight probe`, which runs body()."""
    module = ModuleType("probe_command")
    module.app = typer.Typer(add_completion=False)
    module.app.command()(body)
    monkeypatch.setitem(sys.modules, "probe_command", module)
    monkeypatch.setitem(cli.COMMANDS, "probe", ("probe_command", "Probe."))


def run_probe(monkeypatch, capsys, error):
    def body() -> None:
        raise error

    add_command(monkeypatch, body)
    status = cli.main(["probe"])
    out, err = capsys.readouterr()
    assert out == ""
    return status, err


def interrupted_inside_a_compiled_call():
    error = SystemError("returned a result with an exception set")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (MapError("a.lode is no map; choose another"), 2),
        (RunError("lost throughout"), 1),
        (OSError(errno.ENOSPC, "No space left on device", "out/cloud.ply"), 2),
        (PermissionError(errno.EACCES, "Permission denied", "out"), 2),
        (KeyboardInterrupt(), 130),
        (interrupted_inside_a_compiled_call(), 130),
    ],
)
def test_what_goes_wrong_is_one_line_and_a_status(monkeypatch, capsys, error, status):
    got, err = run_probe(monkeypatch, capsys, error)
    assert got == status
    assert err.count("\n") <= 1
    assert "Traceback" not in err


def test_an_oserror_names_the_file(monkeypatch, capsys):
    _, err = run_probe(monkeypatch, capsys, OSError(errno.ENOSPC, "No space left on device", "out/cloud.ply"))
    assert "out/cloud.ply" in err
    assert "No space left" in err


def test_a_bug_keeps_its_traceback(monkeypatch, capsys):
    with pytest.raises(ZeroDivisionError):
        run_probe(monkeypatch, capsys, ZeroDivisionError())
    with pytest.raises(SystemError):
        run_probe(monkeypatch, capsys, SystemError("of another kind"))


def test_a_command_that_ends_is_status_0(monkeypatch):
    add_command(monkeypatch, lambda: None)
    assert cli.main(["probe"]) == 0


@pytest.mark.parametrize("argv", [["evaluate"], ["--colour"], ["eval"], ["eval", "a", "b", "--max-dt", "-1"]])
def test_bad_usage_is_one_line_and_status_2(capsys, argv):
    assert cli.main(argv) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "--help" in err


def test_a_missing_file_is_one_line_and_status_2(capsys, tmp_path):
    assert cli.main(["eval", str(tmp_path / "none.tum"), str(tmp_path / "none.tum")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "none.tum" in err


def test_no_command_shows_the_help_as_bad_usage(capsys):
    assert cli.main([]) == 2
    assert "eval" in capsys.readouterr().out


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("lodelight ")


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from lodelight.cli.main import main; main(['--help']);"
        "print(sorted({'numba', 'cv2', 'scipy', 'numpy', 'plotly'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "Compare a trajectory" in done.stdout


def leaves(command, path):
    """Every command that does something, with the words that call it."""
    for name in getattr(command, "commands", {}):
        yield from leaves(command.commands[name], [*path, name])
    if not hasattr(command, "commands"):
        yield path, command


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_help_of_every_command_shows_an_example_and_the_listed_summary(name):
    module = __import__(cli.COMMANDS[name][0], fromlist=["app"])
    command = typer.main.get_command(module.app)
    assert cli.COMMANDS[name][1].rstrip(".") in " ".join(command.help.split())
    for path, leaf in leaves(command, [name]):
        assert f"lodelight {' '.join(path)}" in " ".join((leaf.epilog or leaf.help or "").split()), path
        assert CliRunner().invoke(module.app, [*path[1:], "--help"]).exit_code == 0


def test_progress_is_silent_in_a_pipe(capsys):
    assert list(track(range(3), "rendering", total=3)) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")
