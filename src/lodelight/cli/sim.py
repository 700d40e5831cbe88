"""`lodelight sim`."""

from __future__ import annotations

from pathlib import Path

import typer

app = typer.Typer(add_completion=False)


@app.command(epilog="Example: lodelight sim office --out office --duration 30 --motion walk --seed 1")
def sim(
    scenario: str = typer.Argument("", metavar="SCENARIO", help="Name of a building; --list shows them."),
    out: Path | None = typer.Option(None, "--out", help="Folder for the recording; one cut short is continued."),
    seed: int = typer.Option(0, min=0, help="Same seed, same bytes."),
    duration: float | None = typer.Option(None, help="Length, s; default: a lap and a fifth, or the trajectory's."),
    motion: str | None = typer.Option(None, help="cart, walk, drone or hand; each building has its own default."),
    path: int = typer.Option(0, min=0, help="0: the building's route; else the number of another way beside it."),
    standstill: float = typer.Option(0.0, help="Seconds at rest before moving off."),
    changed: bool = typer.Option(False, "--changed", help="Furniture moved, posters replaced, some lights out."),
    trajectory: Path | None = typer.Option(None, help="Fly this TUM or EuRoC trajectory instead."),
    place: str | None = typer.Option(
        None, help="Where to fly it: auto, or x,y,z,yaw in m and degrees; default: as it is, auto with --imu."
    ),
    imu: Path | None = typer.Option(None, help="EuRoC csv of a real IMU of that trajectory, passed on unchanged."),
    imu_model: str = typer.Option("euroc", help="euroc, phone or perfect: noise of the simulated IMU."),
    rig: str | None = typer.Option(None, help="standard, camera, euroc, or a rig.toml."),
    cameras: int = typer.Option(2, min=1, max=2, help="Of the standard rig: 2 is stereo."),
    size: str = typer.Option("752x480", help="Image size of the standard rig."),
    rate: float = typer.Option(20.0, help="Images/s of the standard rig."),
    lens: str = typer.Option("radtan", help="radtan or equidistant."),
    depth: bool = typer.Option(True, help="With a depth sensor."),
    lights: bool = typer.Option(True, help="With an upward camera for coded lights."),
    light_rate: float = typer.Option(10.0, help="Images/s of that camera."),
    fault: list[str] = typer.Option([], help="name or name=value, may be repeated; --list names them."),
    threads: int = typer.Option(2, min=1, help="Images rendered at a time; the bytes do not depend on it."),
    plan: Path | None = typer.Option(None, help="Only draw the building from above, to this .png or .html."),
    listing: bool = typer.Option(False, "--list", help="Name buildings and faults, and end."),
    as_json: bool = typer.Option(False, "--json", help="Print the result as JSON."),
) -> None:
    """Render a named building as a recording with ground truth, rig and anchors."""
    if listing:
        return _list()
    if not scenario or (out is None and plan is None):
        raise typer.BadParameter("name a building and a folder, as in: lodelight sim office --out office.")
    from lodelight.cli.progress import track
    from lodelight.sim.plan import write_plan
    from lodelight.sim.recorder import claim, record
    from lodelight.sim.scenarios import Request, prepare

    request = Request(
        scenario,
        seed=seed,
        duration_s=duration,
        motion=motion,
        path=path,
        standstill_s=standstill,
        changed=changed,
        trajectory=str(trajectory) if trajectory else None,
        place=place,
        imu_file=str(imu) if imu else None,
        rig=rig,
        cameras=cameras,
        size=_size(size),
        rate_hz=rate,
        lens=lens,
        depth=depth,
        lights=lights,
        light_rate_hz=light_rate,
        imu=imu_model,
        faults=tuple(fault),
    )
    if out is not None:
        claim(out)
    simulation = prepare(request, threads, lit=out is not None)
    if plan is not None:
        write_plan(plan, simulation.building, simulation.motion)
    if out is not None:
        record(simulation, out, threads, lambda steps, count: track(steps, f"rendering {scenario}", count))
    _report(simulation.summary | {"out": str(out or plan)}, as_json)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise typer.BadParameter(f"--size {text!r} must be WIDTHxHEIGHT, as 752x480.")
    return int(width), int(height)


def _list() -> None:
    from lodelight.sim.faults import NAMES
    from lodelight.sim.scenarios import SCENARIOS

    print("scenario    motion  what")
    for name, (text, motion) in SCENARIOS.items():
        print(f"{name:11s} {motion:7s} {text}")
    print("\nfault           value (default)")
    for name, text in NAMES.items():
        print(f"{name:15s} {text}")


def _report(summary: dict[str, object], as_json: bool) -> None:
    import json

    if as_json:
        print(json.dumps(summary))
    else:
        print(" · ".join(f"{key} {value}" for key, value in summary.items()))
