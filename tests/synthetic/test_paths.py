"""Curves: geometry that can be checked against circles and lines."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spdm_jax.synthetic.paths import Path, connect


def test_constant_curvature_is_a_circle():
    path = Path.from_curvature([(100.0, 1 / 40.0)])
    distance = np.linalg.norm(path.xy - [0.0, 40.0], axis=1)
    np.testing.assert_allclose(distance, 40.0, atol=2e-3)
    assert path.length == pytest.approx(100.0)
    np.testing.assert_allclose(path.curvature, 1 / 40.0, rtol=1e-6)


def test_curvature_has_no_jumps():
    path = Path.from_curvature([(50.0, 0.0), (50.0, 1 / 20.0), (50.0, -1 / 30.0)])
    assert np.max(np.abs(np.diff(path.curvature))) < 0.01


@pytest.mark.parametrize("segments", [[], [(0.0, 0.1)], [(10.0, 0.0), (-1.0, 0.0)]])
def test_segments_need_length(segments):
    with pytest.raises(ValueError, match="segments"):
        Path.from_curvature(segments)


@given(
    station=st.floats(-20.0, 120.0),
    left=st.floats(-8.0, 8.0),
    heading=st.floats(-3.0, 3.0),
)
def test_offset_is_perpendicular_and_found_again(station, left, heading):
    path = Path.from_curvature([(100.0, 0.0)], (5.0, -7.0, heading))
    pose, point = path.pose(station), path.offset(station, left)
    assert np.linalg.norm(point - pose[:2]) == pytest.approx(abs(left), abs=1e-9)
    assert path.station_of(point) == pytest.approx(station, abs=1e-6)


def test_reversed_path_has_the_same_points():
    path = Path.from_curvature([(40.0, 0.0), (60.0, 1 / 50.0)])
    back = path.reversed()
    stations = np.linspace(0.0, 100.0, 33)
    np.testing.assert_allclose(
        back.pose(100.0 - stations)[:, :2], path.pose(stations)[:, :2], atol=1e-9
    )
    np.testing.assert_allclose(
        back.offset(100.0 - stations, -2.0), path.offset(stations, 2.0), atol=1e-9
    )


def test_shift_moves_sideways_between_its_stations():
    path = Path.from_curvature([(100.0, 0.0)])
    shifted = path.shifted(20.0, 60.0, 3.5)
    assert shifted.xy[0, 1] == 0.0 and shifted.xy[-1, 1] == pytest.approx(3.5)
    assert np.all(np.diff(shifted.xy[:, 1]) >= -1e-12)
    assert np.max(np.abs(shifted.xy[shifted.xy[:, 0] < 20.0, 1])) < 1e-9


@given(angle=st.floats(-2.0, 2.0), distance=st.floats(8.0, 40.0))
def test_connecting_curve_meets_both_poses(angle, distance):
    start = np.array([1.0, 2.0, 0.3])
    chord = 0.3 + angle / 2
    end = np.array([1.0 + distance * np.cos(chord), 2.0 + distance * np.sin(chord), 0.3 + angle])
    points = connect(start, end)
    assert np.array_equal(points[0], start[:2]) and np.array_equal(points[-1], end[:2])
    steps = np.diff(points, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    # Half a step of a circle with this chord and angle, and some room.
    tolerance = 0.02 + 1.5 * abs(angle) / (len(points) - 1)
    assert abs(np.sin(heading[0] - start[2])) < tolerance
    assert abs(np.sin(heading[-1] - end[2])) < tolerance
