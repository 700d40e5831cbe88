"""The occupancy grid of a simulated room, and which way is up."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from lodelight.errors import ConfigError
from lodelight.geometry.se3 import SE3
from lodelight.io.occupancy import FREE, OCCUPIED, UNKNOWN
from lodelight.mapping.export import export_grid, map_up
from lodelight.mapping.grid import Grid, occupancy_grid
from lodelight.mapping.map import Map
from lodelight.mapping.upright import estimate_up
from maps import EYE_M, ROOM_M, room_map, room_points, room_rig

Z = np.array([0.0, 0.0, 1.0])


def rays(seed: int = 0, count: int = 30_000) -> tuple[np.ndarray, np.ndarray]:
    """From places all over the room, a metre off its walls, to its walls."""
    rng = np.random.default_rng(seed)
    centres = np.column_stack([rng.uniform(1.0, ROOM_M[:2] - 1.0, (count, 2)), np.full(count, EYE_M)])
    return centres, room_points(rng, count)


def at(grid: Grid, xy: np.ndarray) -> np.ndarray:
    column, row = np.floor((xy - np.array(grid.origin_xy_m)) / grid.resolution_m).astype(int).T
    return grid.cells[row, column]


@pytest.mark.parametrize("resolution_m", [0.05, 0.1, 0.2])
def test_a_room_is_free_inside_and_occupied_at_its_walls_and_unknown_beyond(resolution_m: float) -> None:
    grid = occupancy_grid(*rays(), Z, resolution_m=resolution_m)
    inside = np.random.default_rng(1).uniform(0.5, ROOM_M[:2] - 0.5, (2000, 2))
    assert (at(grid, inside) == FREE).all()
    along = np.linspace(0.01, 0.99, 500)[:, None] * ROOM_M[:2]
    for wall in ([[1, 0]] * along + [[0, ROOM_M[1]]], [[0, 1]] * along + [[ROOM_M[0], 0]]):
        assert (at(grid, wall) == OCCUPIED).mean() > 0.99
    rows, columns = np.nonzero(grid.cells != UNKNOWN)
    low = np.array(grid.origin_xy_m) + resolution_m * np.array([columns.min(), rows.min()])
    high = np.array(grid.origin_xy_m) + resolution_m * np.array([columns.max() + 1, rows.max() + 1])
    assert (low > -1.01 * resolution_m).all()
    assert (high < ROOM_M[:2] + 1.01 * resolution_m).all()


def test_a_lone_wrong_point_in_looked_through_space_is_outvoted_and_a_pillar_is_not() -> None:
    centres, points = rays()
    rng = np.random.default_rng(2)
    middle, turn = np.array([3.0, 2.0]), rng.uniform(0, 2 * np.pi, 3000)
    around = np.column_stack([np.cos(turn), np.sin(turn)])
    pillar = np.column_stack([middle + 0.2 * around, rng.uniform(0, 2, 3000)])
    before_it = np.column_stack([middle + 1.2 * around, np.full(3000, EYE_M)])
    path, to_middle = (points - centres)[:, :2], middle - centres[:, :2]
    aside = np.abs(path[:, 0] * to_middle[:, 1] - path[:, 1] * to_middle[:, 0]) / np.linalg.norm(path, axis=1)
    past = aside > 0.3  # the pillar stops the other rays
    wrong = np.array([[4.52, 2.53, 1.0]])
    grid = occupancy_grid(
        np.vstack([centres[past], before_it, [[5.0, 1.0, EYE_M]]]), np.vstack([points[past], pillar, wrong]), Z
    )
    assert at(grid, wrong[:, :2])[0] == FREE
    assert (at(grid, pillar[:, :2]) == OCCUPIED).mean() > 0.95


def test_floor_and_ceiling_are_no_obstacles_and_the_floor_is_found() -> None:
    centres, points = rays()
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(0.5, ROOM_M[:2] - 0.5, (10_000, 2)), rng.choice([0.0, ROOM_M[2]], 10_000)])
    flat[:, 2] += rng.normal(0.0, 0.02, len(flat))
    grid = occupancy_grid(np.vstack([centres, centres[:10_000]]), np.vstack([points, flat]), Z)
    assert abs(grid.floor_m) < 0.05
    inside = rng.uniform(0.5, ROOM_M[:2] - 0.5, (2000, 2))
    assert (at(grid, inside) == FREE).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_map_that_lies_on_its_side_gives_the_same_grid_once_up_is_said(seed: int) -> None:
    centres, points = rays()
    T = SE3.exp(np.append(np.random.default_rng(seed).normal(0.0, 1.5, 3), [1.0, -2.0, 3.0]))
    grid = occupancy_grid(T @ centres, T @ points, T.R @ Z)
    np.testing.assert_allclose(grid.R_grid_map @ T.R @ Z, Z, atol=1e-12)
    inside = np.random.default_rng(1).uniform(0.5, ROOM_M[:2] - 0.5, (2000, 2))
    turned = (np.column_stack([inside, np.ones(2000)]) @ T.R.T + T.t) @ grid.R_grid_map.T
    assert (at(grid, turned[:, :2]) == FREE).mean() > 0.995  # its walls are no rows of cells now, their noise differs


@pytest.mark.parametrize("up", [Z, -Z, [1.0, 0, 0], [0, -1.0, 0], [0.6, 0.0, -0.8]])
def test_the_grid_stands_upright_whichever_way_up_is(up: object) -> None:
    grid = occupancy_grid(np.zeros((1, 3)), np.array([[1.0, 1.0, 1.0]]), np.asarray(up), band_m=(-5, 5), floor_m=0.0)
    np.testing.assert_allclose(grid.R_grid_map @ up, Z, atol=1e-12)
    np.testing.assert_allclose(grid.R_grid_map @ grid.R_grid_map.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(grid.R_grid_map) > 0


def test_what_cannot_be_a_grid_is_refused() -> None:
    centres, points = rays(count=100)
    with pytest.raises(ConfigError, match="choose a coarser resolution"):
        occupancy_grid(centres, points, Z, resolution_m=0.001)
    with pytest.raises(ConfigError, match="no point lies within"):
        occupancy_grid(centres, points + 100.0, Z)
    with pytest.raises(ConfigError, match="above the floor"):
        occupancy_grid(centres, points, Z, floor_m=50.0)


def test_files_are_what_map_server_reads(tmp_path: Path) -> None:
    """Value, place and orientation of each cell, by map_server's own rules."""
    map = room_map(n_keyframes=30, n_points=2000)
    told = export_grid(map, tmp_path / "room.yaml")
    about = yaml.safe_load((tmp_path / "room.yaml").read_text())
    picture = cv2.imread(str(tmp_path / about["image"]), cv2.IMREAD_UNCHANGED)
    occupied_p = (255 - picture.astype(float)) / 255
    assert about["negate"] == 0
    occupied, free = occupied_p > about["occupied_thresh"], occupied_p < about["free_thresh"]
    assert (int(occupied.sum()), int(free.sum())) == (told["occupied"], told["free"])
    assert not (occupied | free).all()
    row, column = np.nonzero(occupied)
    x = about["origin"][0] + (column + 0.5) * about["resolution"]
    y = about["origin"][1] + (picture.shape[0] - row - 0.5) * about["resolution"]
    off_wall = np.minimum(np.minimum(abs(x), abs(x - ROOM_M[0])), np.minimum(abs(y), abs(y - ROOM_M[1])))
    assert off_wall.max() <= about["resolution"] / 2 + 1e-6  # the walls are on cell borders


# -- up -------------------------------------------------------------------------------------------------------------


def looking(rng: np.random.Generator, count: int, pitch_deg: float) -> np.ndarray:
    """R_world_cam of hand-held cameras, up is z: any yaw, pitched down by a mean, 10 degrees of roll."""
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    out = []
    for _ in range(count):
        yaw, pitch, roll = rng.uniform(-np.pi, np.pi), np.radians(rng.normal(pitch_deg, 5.0)), rng.normal(0.0, 0.17)
        R = SE3.exp(np.array([0, 0, yaw, 0, 0, 0])).R @ level
        out.append(R @ SE3.exp(np.array([-pitch, 0, 0, 0, 0, 0])).R @ SE3.exp(np.array([0, 0, roll, 0, 0, 0])).R)
    return np.array(out)


@pytest.mark.parametrize("pitch_deg", [0.0, 40.0])
@pytest.mark.parametrize("seed", range(3))
def test_up_is_found_from_the_floor_in_any_frame(seed: int, pitch_deg: float) -> None:
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(0.0, ROOM_M[:2], (2000, 2)), np.zeros(2000)])
    points = np.vstack([floor, room_points(rng, 4000)]) + rng.normal(0.0, 0.02, (6000, 3))
    R_world_cam = looking(rng, 40, pitch_deg)
    centres = np.column_stack([rng.uniform(1.0, ROOM_M[:2] - 1.0, (40, 2)), np.full(40, EYE_M)])
    T = SE3.exp(np.append(rng.normal(0.0, 1.5, 3), [1.0, -2.0, 3.0]))
    up, share = estimate_up(T @ points, T.R @ R_world_cam, T @ centres, seed)
    assert np.degrees(np.arccos(up @ T.R @ Z)) < 0.5  # 2000 points of 2 cm over 4 m: 0.01; wall feet in the slab pull
    assert share > 0.3


def test_a_level_camera_that_sees_walls_alone_takes_none_for_the_floor() -> None:
    rng = np.random.default_rng(0)
    R_world_cam = looking(rng, 40, 0.0)
    centres = np.column_stack([rng.uniform(1.0, ROOM_M[:2] - 1.0, (40, 2)), np.full(40, EYE_M)])
    up, share = estimate_up(room_points(rng, 6000), R_world_cam, centres)
    assert share == 0.0
    assert np.degrees(np.arccos(up @ Z)) < 5.0  # what 40 cameras of 10 degrees leave, at three sigma


def test_too_few_points_leave_the_cameras_own_up() -> None:
    up, share = estimate_up(np.zeros((2, 3)), np.eye(3)[None], np.zeros((1, 3)))
    np.testing.assert_allclose(up, [0.0, -1.0, 0.0])
    assert share == 0.0


def moved(map: Map, T: SE3) -> Map:
    """The same map in another frame."""
    for k in range(len(map.keyframes)):
        map.set_pose(k, T @ map.pose(k))
    map.points.xyz[:] = T @ map.points.xyz
    return map


def test_the_maps_z_is_up_unless_what_it_shows_belies_it() -> None:
    """The simulated room has walls alone: what is known of up is how its cameras are held."""
    up, how = map_up(room_map())
    assert up.tolist() == Z.tolist()
    assert "its z" in how
    T = SE3.exp(np.array([1.5, -0.4, 0.7, 1.0, 2.0, 3.0]))
    up, how = map_up(moved(room_map(), T))
    assert np.degrees(np.arccos(up @ T.R @ Z)) < 5.0  # the cameras are tilted by 2 degrees at random
    assert "better give it" in how
    assert map_up(Map(room_rig()))[0].tolist() == Z.tolist()
