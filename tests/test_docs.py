"""The documentation: every command on it is one that there is, those that cost little run, and so do its scripts."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import shlex
import shutil
from pathlib import Path

import cv2
import pytest
import typer

from lodelight.anchors import Anchors
from lodelight.cli.main import COMMANDS, UsageError, main
from lodelight.io.anchors_toml import write_anchors
from lodelight.io.convert import convert
from lodelight.io.rig_toml import write_rig
from tagged_wall import RIG, TAGS, wall_picture, write_walk

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "benchmarks" / "README.md",
    *sorted(ROOT.glob("docs/*.md")),
]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.M | re.S)
# What is only checked, and why: tests of their own run these commands, on what they need.
ONLY_CHECKED = {
    "demo": "test_demo", "sim": "renders for longer", "lights": "test_cli_lights", "calibrate": "test_calibrate",
    "bench": "test_bench", "doctor": "test_doctor", "tags map": "test_slam_tags", "run 0": "test_camera",
    "--view": "test_view", "--web": "test_view", "--scheduler": "test_fleet", "mono-inertial": "test_inertial_odometry",
    "run office": "test_light_gate", "recordings/office": "renders for longer", "fleet": "test_fleet",
    "--format grid": "test_cli_map", "--sensors mono --out": "test_first_views", "eval out/mono": "test_first_views",
}  # fmt: skip


def blocks(page: Path, *languages: str) -> list[str]:
    return [text for language, text in BLOCK.findall(page.read_text(encoding="utf-8")) if language in languages]


def commands() -> list[tuple[str, list[str]]]:
    """(page, words) of every command line in the shell blocks, each once."""
    found: dict[tuple[str, ...], str] = {}
    for page in PAGES:
        for block in blocks(page, "bash", "console"):
            console = block.startswith("$ ")
            for line in block.splitlines():
                if console and not line.startswith("$ "):
                    continue
                for part in line.removeprefix("$ ").split("&&"):
                    words = shlex.split(part, comments=True)
                    if words:
                        found.setdefault(tuple(words), page.name)
    return [(page, list(words)) for words, page in found.items()]


ALL = commands()
OURS = [(page, words[1:]) for page, words in ALL if words[0] == "lodelight"]


def told(value: object) -> str:
    return " ".join(value) if isinstance(value, list) else str(value)


@pytest.mark.parametrize(("page", "words"), OURS, ids=told)
def test_every_command_has_the_options_that_the_page_gives_it(page, words):
    if words[0].startswith("--"):
        return
    assert words[0] in COMMANDS
    command = typer.main.get_command(importlib.import_module(COMMANDS[words[0]][0]).app)
    rest = words[1:]
    if hasattr(command, "commands"):
        assert rest[0] in command.commands
        command, rest = command.commands[rest[0]], rest[1:]
    try:
        command.make_context(words[0], list(rest))
    except UsageError as error:
        pytest.fail(f"{page}: {error.format_message()}")


@pytest.mark.parametrize(("page", "words"), [(p, w) for p, w in ALL if w[0] == "python"], ids=told)
def test_every_script_and_module_is_there_and_knows_its_options(page, words):
    if words[1] == "-m":
        assert importlib.util.find_spec(words[2]) is not None
        return
    source = (ROOT / words[1]).read_text(encoding="utf-8")
    for option in (word for word in words[2:] if word.startswith("--")):
        assert f'"{option}"' in source, page


def test_other_tools_are_few_and_known():
    others = {words[0] for _, words in ALL} - {"lodelight", "python"}
    assert others <= {"pip", "pytest", "python3", ".", "ls", "source", "bash"}


def is_run(words: list[str]) -> bool:
    line = " ".join(words)
    return not any(line.startswith(skipped) or f" {skipped}" in line for skipped in ONLY_CHECKED)


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with everything that the pages take for granted, each a few frames long."""
    folder = tmp_path_factory.mktemp("desk")
    wall = wall_picture()
    (folder / "recordings").mkdir()
    write_walk(folder / "recordings" / "room", wall, 0, 8)
    write_walk(folder / "recordings" / "kitchen", wall, 0, 8, step_ns=500_000_000)
    for name in ("later", "walk", "other", "hall"):
        shutil.copytree(folder / "recordings" / "room", folder / "recordings" / name)
    image = next((folder / "recordings/room/mav0/cam0/data").glob("*.png"))
    cv2.imwrite(str(folder / "photo.jpg"), cv2.imread(str(image)))
    for name in ("camera.toml", "rig.toml"):
        write_rig(folder / name, RIG)
    (folder / "out" / "tags").mkdir(parents=True)
    write_anchors(folder / "out" / "tags" / "anchors.toml", Anchors(TAGS))
    convert(folder / "recordings" / "room", folder / "drive.bag")
    for day, part in (("monday", (0, 10)), ("tuesday", (2, 14))):
        write_walk(folder / "recordings" / day, wall, *part)
    return folder


@pytest.fixture
def at_desk(desk, monkeypatch):
    monkeypatch.chdir(desk)
    for made in ("kitchen.mcap", "kitchen_euroc", "drive_result.bag"):  # by another page
        path = desk / made
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    for name in ("room", "drive", "monday", "tuesday"):
        source = "recordings/" + ("room" if name == "drive" else name)
        if not (desk / "out" / name / "map.lode").exists():
            assert main(["run", source, "--out", f"out/{name}"]) == 0
    if not (desk / "out" / "map.lode").exists():
        shutil.copy(desk / "out" / "room" / "map.lode", desk / "out" / "map.lode")
    return desk


@pytest.mark.parametrize(("page", "words"), [(p, w) for p, w in OURS if is_run(w)], ids=told)
def test_what_costs_little_runs(at_desk, capsys, page, words):
    if "--rrd" in words:
        pytest.importorskip("rerun", reason='needs rerun (pip install "lodelight[viewer]")')
    assert main(words) == 0, (page, capsys.readouterr().err)


SCRIPTS = [
    (page.name, block)
    for page in PAGES
    for block in blocks(page, "python")
    if re.search(r"^(import|from) lodelight", block, re.M) and page.name != "map-file.md"  # which its own test runs
]


@pytest.mark.parametrize(("page", "script"), SCRIPTS, ids=[f"{page}-{i}" for i, (page, _) in enumerate(SCRIPTS)])
def test_scripts_run_as_they_stand(at_desk, capsys, page, script):
    if "rerun" in script:
        pytest.importorskip("rerun", reason='needs rerun (pip install "lodelight[viewer]")')
    before = os.environ.copy()
    exec(compile(script, page, "exec"), {"__name__": "__main__"})
    assert os.environ == before
