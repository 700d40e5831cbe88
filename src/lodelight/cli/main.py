"""`lodelight`: finds the command, runs it, and turns what went wrong into one line and an exit status.

A command is a module with `app = typer.Typer(add_completion=False)`, named in COMMANDS. `lodelight --help` imports
none of them; a command's module is imported when it runs, and imports numpy and heavier things inside its function.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any

import typer
import typer.core

from lodelight import __version__
from lodelight.errors import LodelightError, RunError

# name: (module, the first line of its help)
COMMANDS = {
    "demo": ("lodelight.cli.demo", "Simulate two buildings, run the three systems in them, say how exact each was."),
    "sim": ("lodelight.cli.sim", "Render a named building as a recording with ground truth, rig and anchors."),
    "run": ("lodelight.cli.run", "SLAM over a recording: trajectory, map and report."),
    "localize": ("lodelight.cli.localize", "Find and follow a camera in a saved map, which is never changed."),
    "doctor": ("lodelight.cli.doctor", "Check a recording and its calibration: what is wrong, and by how much."),
    "convert": ("lodelight.cli.convert", "Turn any readable recording, trajectory or rig into a writable one."),
    "eval": ("lodelight.cli.evaluate", "Compare a trajectory with the truth: ATE, RPE, coverage, NEES."),
    "lights": (
        "lodelight.cli.lights",
        "Visible light positioning: decode coded lights, plan their frequencies, calibrate the camera.",
    ),
    "tags": ("lodelight.cli.tags", "Printed tags: map where they hang, print them at true size."),
    "calibrate": ("lodelight.cli.calibrate", "Find a camera's lens from images of a printed tag board."),
    "map": ("lodelight.cli.map", "Inspect, check, export and merge saved maps."),
    "fleet": (
        "lodelight.cli.fleet",
        "SLAM over many recordings of one building, here or on a cluster, and one map of them all.",
    ),
    "bench": ("lodelight.cli.bench", "Time and error over recordings on this machine: medians and ranges."),
}

# Typer keeps a copy of click of its own since 0.16; by this name the class is the right one in both.
UsageError: Any = typer.BadParameter.__base__


class LazyGroup(typer.core.TyperGroup):
    """Lists COMMANDS without importing them, and imports the one that was asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        return typer.core.TyperCommand(cmd_name, help=COMMANDS[cmd_name][1])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name, _, rest = super().resolve_command(ctx, args)
        module = importlib.import_module(COMMANDS[str(name)][0])
        return name, typer.main.get_command(module.app), rest


app = typer.Typer(name="lodelight", cls=LazyGroup, add_completion=False)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"lodelight {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True, epilog="Example: lodelight eval out/trajectory.tum truth.tum --align se3")
def root(
    ctx: typer.Context,
    version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True, help="Print the version."),
) -> None:
    """Indoor visual SLAM and localization, anchored by the building itself."""
    if ctx.invoked_subcommand is None:
        print(ctx.get_help())
        raise typer.Exit(2)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 done, 1 ran and failed, 2 bad usage or input, 130 interrupted.

    Anything but LodelightError, OSError and an interrupt is a bug of ours and keeps its traceback.
    """
    # Small dense algebra is slower with several BLAS threads, and its bytes then depend on their number.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        status = typer.main.get_command(app).main(args=argv, prog_name="lodelight", standalone_mode=False)
    except UsageError as error:
        command = error.ctx.command_path if error.ctx else "lodelight"
        return _fail(2, f'{error.format_message().rstrip(".")}; see "{command} --help"')
    except RunError as error:
        return _fail(1, f"{type(error).__name__}: {error}")
    except LodelightError as error:
        return _fail(2, f"{type(error).__name__}: {error}")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(2, f"{where}{error.strerror or error}; check that the path exists, is writable and has space")
    except (KeyboardInterrupt, typer.Abort):
        return _fail(130, "interrupted")
    except SystemError as error:
        if not _interrupted(error):
            raise
        return _fail(130, "interrupted")
    return status if isinstance(status, int) else 0


def _interrupted(error: BaseException | None) -> bool:
    """Whether an interrupt is at the bottom of it: one that comes inside a compiled call surfaces as SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _fail(status: int, message: str) -> int:
    print("lodelight: " + " ".join(message.split()), file=sys.stderr)
    return status
