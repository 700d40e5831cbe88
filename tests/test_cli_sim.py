"""`lodelight sim` as a user types it: what it says when it cannot, and what it draws."""

import json

import numpy as np
import pytest

from lodelight.cli.main import main
from lodelight.io.trajectories import write_tum
from lodelight.sim.buildings.tunnel import ROUTE
from lodelight.sim.gaits import GAITS, generate
from lodelight.sim.scenarios import Request, prepare
from lodelight.trajectory import Trajectory


def refused(capsys, *arguments):
    """The one line on standard error of a call that must end with status 2."""
    assert main(["sim", *map(str, arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1, err
    return err


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A TUM file of a flight through the tunnel, and its poses."""
    tmp_path = tmp_path_factory.mktemp("flight")
    trajectory = generate(GAITS["drone"], ROUTE, 20.0, 10**18, np.random.default_rng(0)).trajectory(20.0)
    write_tum(tmp_path / "flight.tum", trajectory)
    return tmp_path / "flight.tum", trajectory


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["castle"], "unknown scenario 'castle'; choose one of office, warehouse"),
        (["tunnel", "--motion", "swim"], "unknown motion 'swim'"),
        (["tunnel", "--lens", "pinhole"], "unknown lens 'pinhole'"),
        (["tunnel", "--imu-model", "dear"], "unknown IMU 'dear'"),
        (["tunnel", "--size", "big"], "WIDTHxHEIGHT"),
        (["tunnel", "--size", "8x8"], "32..8192"),
        (["tunnel", "--duration", "-3"], "duration must be a positive"),
        (["tunnel", "--duration", "nan"], "duration must be a positive"),
        (["tunnel", "--rate", "0"], "rate must be a positive"),
        (["tunnel", "--standstill", "-1"], "standstill must not be negative"),
        (["tunnel", "--fault", "fog"], "unknown fault 'fog'; choose one of dropped"),
        (["tunnel", "--fault", "light=L99"], "has no 'L99'"),
        (["tunnel", "--rig", "nowhere.toml"], "unknown rig 'nowhere.toml'"),
        (["tunnel", "--imu", "imu.csv"], "give its --trajectory too"),
        (["tunnel", "--trajectory", "nowhere.tum"], "nowhere.tum does not exist"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(arguments, says, capsys, tmp_path):
    assert says in refused(capsys, *arguments, "--out", tmp_path / "out")


def test_a_place_that_cannot_be_written_is_named(capsys, tmp_path):
    (tmp_path / "file").write_text("x")
    assert "cannot write to" in refused(capsys, "tunnel", "--out", tmp_path / "file" / "out")
    assert "cannot write to" in refused(capsys, "tunnel", "--out", tmp_path / "file")
    assert "not empty" in refused(capsys, "tunnel", "--out", tmp_path)
    assert ".png or .html" in refused(capsys, "tunnel", "--plan", tmp_path / "plan.gif")


def test_a_trajectory_that_does_not_fit_is_refused(capsys, tmp_path, flight):
    path, trajectory = flight
    out = ["--out", tmp_path / "out"]
    assert "shorter than the 60 s" in refused(capsys, "tunnel", "--trajectory", path, "--duration", 60, *out)
    assert "give --place" in refused(capsys, "tunnel", "--trajectory", path, "--place", "0,6,0,0", *out)
    assert "x,y,z,yaw" in refused(capsys, "tunnel", "--trajectory", path, "--place", "here", *out)
    write_tum(tmp_path / "short.tum", Trajectory(trajectory.t_ns[:5], trajectory.xyz[:5], trajectory.quat_xyzw[:5]))
    assert "at least 8" in refused(capsys, "tunnel", "--trajectory", tmp_path / "short.tum", *out)
    (tmp_path / "text.tum").write_text("to be or not to be\n")
    assert "text.tum" in refused(capsys, "tunnel", "--trajectory", tmp_path / "text.tum", *out)


def test_an_imu_file_that_does_not_fit_is_refused(capsys, tmp_path, flight):
    path, _trajectory = flight
    rest = ["tunnel", "--trajectory", path, "--place", "0,0,0,0", "--out", tmp_path / "out", "--imu"]
    assert "does not exist" in refused(capsys, *rest, tmp_path / "none.csv")
    (tmp_path / "empty.csv").write_text("#t,wx,wy,wz,ax,ay,az\n")
    assert "empty.csv" in refused(capsys, *rest, tmp_path / "empty.csv")
    (tmp_path / "text.csv").write_text("a,b,c\nd,e,f\n")
    assert "text.csv" in refused(capsys, *rest, tmp_path / "text.csv")
    rows = "".join(f"{k * 5_000_000},0,0,0,0,0,9.81\n" for k in range(100))
    (tmp_path / "other.csv").write_text(rows)
    assert "on one clock" in refused(capsys, *rest, tmp_path / "other.csv")


def test_a_real_imu_is_passed_on_unchanged(tmp_path, flight):
    path, trajectory = flight
    t_ns = trajectory.t_ns[0] + 5_000_000 * np.arange(-10, 500)
    readings = np.random.default_rng(0).normal(size=(len(t_ns), 6))
    (tmp_path / "imu.csv").write_text(
        "".join(f"{t},{','.join(map(repr, row))}\n" for t, row in zip(t_ns.tolist(), readings.tolist(), strict=True))
    )
    request = Request(
        "tunnel", trajectory=str(path), imu_file=str(tmp_path / "imu.csv"), place="0,0,0,0", duration_s=2.0
    )
    simulation = prepare(request, lit=False)
    assert np.array_equal(simulation.imu.t_ns, t_ns[10:411])
    assert np.array_equal(simulation.imu.gyro, readings[10:411, :3])
    assert np.array_equal(simulation.imu.accel, readings[10:411, 3:])


def test_plans_are_drawn_and_repeat(capsys, tmp_path):
    for name in ("a.html", "b.html"):
        assert main(["sim", "tunnel", "--plan", str(tmp_path / name), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["tags"] > 10
    page = (tmp_path / "a.html").read_text()
    assert page == (tmp_path / "b.html").read_text()
    assert "L01" in page
    assert "tag36h11" in page
    assert 'src="http' not in page


def test_the_list_names_buildings_and_faults(capsys):
    assert main(["sim", "--list"]) == 0
    said = capsys.readouterr().out
    assert all(word in said for word in ("office", "tunnel", "walk", "kidnap", "swapped-lights"))
