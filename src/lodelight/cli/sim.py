"""`lodelight sim`: a recording with truth, from a named building."""

from __future__ import annotations

from pathlib import Path

import typer

app = typer.Typer(add_completion=False)


@app.command(epilog="Example: lodelight sim office --out office --duration 30 --motion walk")
def sim(
    scenario: str = typer.Argument("", help="Name of a building; --list shows them."),
    out: Path = typer.Option(None, help="Folder for the recording; one that was cut short is continued."),
    seed: int = typer.Option(0, help="Same seed, same bytes."),
    duration: float = typer.Option(60.0, help="Length, s."),
    motion: str = typer.Option(None, help="cart, walk, drone or hand; each building has its own default."),
    changed: bool = typer.Option(False, "--changed", help="Furniture moved, posters replaced, some lights out."),
    listing: bool = typer.Option(False, "--list", help="Name the buildings and end."),
) -> None:
    """Render a named building as a recording with ground truth, rig and anchors."""
    from lodelight.cli.progress import track
    from lodelight.sim.scenarios import SCENARIOS, simulate

    if listing:
        for name, (text, kind) in SCENARIOS.items():
            print(f"{name:10s} {text}; {kind}")
        return
    if not scenario or out is None:
        raise typer.BadParameter("name a building and a folder, as in: lodelight sim office --out office")
    simulate(
        scenario,
        out,
        seed,
        duration,
        motion,
        changed=changed,
        progress=lambda steps, count: track(steps, f"rendering {scenario}", count),
    )
    print(out)
