"""The search for the mildest unsafe point, where the answer is known by the formula of a plane."""

from __future__ import annotations

import numpy as np
import pytest

from proofs.studies.adversary import Found, Space, mildest

#: Coordinates: of the first two only one may act, the last two have a sign.
SIZE = 12

#: By how much the steepest ascent falls short of the limits of the lungs.
LIMITS = np.array([2.0, 1.6, 6.0])


def slopes() -> np.ndarray:
    slope = np.abs(np.random.default_rng(7).normal(size=(len(LIMITS), SIZE)))
    slope[:, 1] *= 0.3
    slope[:, -2] *= -1.0
    return slope


@pytest.fixture(scope="module")
def space() -> Space:
    group = np.arange(SIZE)
    group[1] = group[0]
    return Space(group, np.arange(SIZE) >= SIZE - 2)


@pytest.fixture(scope="module")
def found(space: Space) -> Found:
    def margin(points: np.ndarray, at: np.ndarray) -> np.ndarray:
        # The second setting is a tenth worse.
        return at * np.einsum("...la,la->...l", points, slopes()) - LIMITS

    return mildest(margin, space, len(LIMITS), (1.0, 1.1))


def nearest(lung: int) -> float:
    """Distance from the origin to the plane, with one of the first two coordinates left out."""
    steepest = max(np.linalg.norm(np.delete(slopes()[lung], left_out)) for left_out in (0, 1))
    return LIMITS[lung] / (1.1 * steepest)


def test_combinations_reach_the_plane_by_nearly_the_shortest_way(found: Found) -> None:
    for lung in (0, 1):
        least = nearest(lung)
        assert least < found.severity[lung] < 1.05 * least
        point = found.point[lung]
        assert np.linalg.norm(point) == pytest.approx(found.severity[lung])
        assert not point[:2].all(), "one of a group"
        assert (point[:-2] >= 0).all()
        assert found.setting[lung] == 1.1
        assert 0 < found.margin[lung] < 0.1


def test_what_lies_beyond_the_range_is_not_found(found: Found) -> None:
    assert nearest(2) > 1.0
    assert np.isnan(found.severity[2])
    assert found.margin[2] < 0.0
    assert np.linalg.norm(found.point[2]) == pytest.approx(1.0), "the end of the range"


def test_what_is_wrong_from_the_start_has_severity_0(space: Space) -> None:
    answer = mildest(lambda x, at: np.full(x.shape[:-1], np.inf), space, 3, (1.0,))
    np.testing.assert_array_equal(answer.severity, 0.0)
    np.testing.assert_array_equal(answer.point, 0.0)


def test_islands_are_entered_at_their_near_edge(space: Space) -> None:
    """Safe again beyond: only what is asked at the end of an interval would miss it."""

    def margin(points: np.ndarray, at: np.ndarray) -> np.ndarray:
        return 0.2 - np.abs(points[..., 3] - 0.6)

    answer = mildest(margin, space, 3, (1.0,))
    np.testing.assert_allclose(answer.severity, 0.4, atol=0.02)
