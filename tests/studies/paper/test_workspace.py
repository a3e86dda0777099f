"""One model or several: neighbours by place, maps on their grid, intervals over leg-runs."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact_studies.cache import plain
from adaptive_contact_studies.paper.tables import sections
from adaptive_contact_studies.paper.workspace import (
    CELL_M,
    difference_of,
    edges_of,
    map_extent,
    nearest_regions,
    residual_map,
    workspace,
)


def test_neighbours_are_near_by_their_centres() -> None:
    """Corners of a box that is longest along x and shortest along z."""
    region = np.arange(8)
    corners = np.stack([region >> 2 & 1, region >> 1 & 1, region & 1], axis=1)
    point = np.repeat(corners * np.array([0.3, 0.2, 0.1]), 5, axis=0)
    assert nearest_regions(point, np.repeat(region, 5)) == [1, 0, 3, 2, 5, 4, 7, 6]


def test_a_region_without_rows_is_nobodys_neighbour() -> None:
    region = np.array([0, 2, 3, 4, 5, 6, 7])
    point = np.stack([region * 0.1, np.zeros(7), np.zeros(7)], axis=1)
    assert nearest_regions(point, region)[0] == 2


def test_the_maps_extent_is_that_of_its_cells() -> None:
    """A residual at one place is drawn at that place."""
    left, right, bottom, top = map_extent()
    place = np.array([0.2, 0.0, 0.131])  # above the span asked for, within the last cell
    grid = np.array(residual_map(np.tile(place, (20, 1)), np.full((20, 3), 0.01)), dtype=np.float64)
    lines, columns = grid.shape
    assert right - left == pytest.approx(columns * CELL_M)
    assert top - bottom == pytest.approx(lines * CELL_M)
    (line,), (column,) = np.nonzero(np.isfinite(grid))
    assert left + column * CELL_M <= place[0] < left + (column + 1) * CELL_M
    assert bottom + line * CELL_M <= place[2] < bottom + (line + 1) * CELL_M
    assert len(edges_of((0.0, 0.045))) == 3


def test_the_difference_has_students_interval() -> None:
    pairs = [([0.9, 0.9], [1.0, 1.0]), ([0.98, 0.98], [1.0, 1.0]), ([1.01, 1.01], [1.0, 1.0])]
    found = difference_of([*pairs, (None, [1.0, 1.0])])
    ratio = np.array([-0.1, -0.02, 0.01])
    assert found["leg_runs"] == 3
    assert found["smaller_in"] == 2
    assert found["mean"] == pytest.approx(ratio.mean())
    half = 4.302653 * ratio.std(ddof=1) / np.sqrt(3)  # t of two degrees of freedom
    assert found["interval"] == pytest.approx([ratio.mean() - half, ratio.mean() + half])
    assert plain(difference_of(pairs[:1]))["interval"] == [None, None]
    assert difference_of([])["mean"] is None


@pytest.mark.parametrize(
    ("several", "unseen", "said"),
    [
        (0.98, 1.30, "gain a little where the leg has been, and lose where it has not"),
        (0.98, 0.97, "would gain in both; one is kept all the same"),
        (1.02, 1.30, "Several gain nothing"),
    ],
)
def test_the_decision_says_what_the_other_choice_would_gain(
    several: float, unseen: float, said: str
) -> None:
    def study(noise: float) -> dict[str, object]:
        rms = {
            "one model": [1.0] * 3,
            "one per region": [several + noise] * 3,
            "region unseen, one model of the others": [1.0] * 3,
            "region unseen, nearest region's model": [unseen + noise] * 3,
        }
        return {"rms_deg": rms, "status": dict.fromkeys(rms, "ok")}

    studies = {
        f"0-{i}": {"servo": study(noise), "paper": study(noise)}
        for i, noise in enumerate((-0.001, 0.0, 0.001))
    }
    section = sections({"workspace": plain(workspace(studies))})[0]
    assert "**The product uses one model.**" in section.text
    assert said in section.text
    assert f"{100 * (several - 1):+.1f} %" in section.text
    assert section.tables[1].rows[0][2] == "3"
