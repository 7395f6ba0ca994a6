"""The hull of many large silhouettes takes the memory of one, and is the same."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rigs

from reflfield.geometry.cones import measured_views
from reflfield.geometry.explanations import Inverted
from reflfield.geometry.silhouette_distance import signed_distance
from reflfield.geometry.specks import Cleaned, without_specks
from reflfield.geometry.visual_hull import HullOptions, visual_hull

OPTIONS = HullOptions(resolution=24, smoothing=4, n_triangles=0)

MANY = """
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil
import rigs

from reflfield.geometry.visual_hull import HullOptions, visual_hull
from reflfield.pipeline.cache import MemoryWatch

SIZE = 1200


class Discs(Sequence):
    def __len__(self):
        return 30

    def __getitem__(self, view):
        if view >= len(self):
            raise IndexError
        row, col = np.ogrid[:SIZE, :SIZE]
        # Radius of the outline of a ball of radius 1 seen from a distance of 4.
        reach = 1.5 * SIZE / 15**0.5
        inside = (row + 0.5 - SIZE / 2) ** 2 + (col + 0.5 - SIZE / 2) ** 2 < reach**2
        return inside.astype(np.float32)


def hull(cameras, silhouettes, **words):
    options = HullOptions(resolution=24, smoothing=4, n_triangles=0)
    return visual_hull(cameras, silhouettes, options, **words)[0]


# Libraries are loaded and kernels compiled by a small one.
small = rigs.cameras(6, 64)
hull(small, [rigs.ball_silhouette(camera) for camera in small])
before = psutil.Process().memory_info().rss
with MemoryWatch(0.01) as watch:
    mesh = hull(rigs.cameras(len(Discs()), SIZE), Discs(), scratch=Path(sys.argv[1]))
print(watch.peak_bytes - before, mesh.volume)
"""


@pytest.mark.slow
def test_many_large_silhouettes_take_the_memory_of_one(tmp_path):
    here = str(Path(__file__).parent)
    path = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-c", MANY, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    peak, volume = (float(word) for word in done.stdout.split())
    # Coverage and distance of all are 30 x 8 bytes a pixel; measuring one takes 25. The other
    # half is room for what the allocator keeps.
    assert peak < 0.5 * 30 * 8 * 1200**2
    # A ball, a little larger where no camera looks along its outline; 24 voxels across.
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.1)


class TestDistancesInFiles:
    def test_are_those_in_memory(self, tmp_path):
        outline = signed_distance(rigs.ball_silhouette(rigs.cameras(3, 48)[0]))
        moved = outline.moved_to(tmp_path / "distances.npy")
        np.testing.assert_array_equal(moved.values, outline.values)
        points = np.array([[3.0, 4.0], [24.0, 24.0], [-5.0, 60.0]])
        np.testing.assert_array_equal(moved.at(points), outline.at(points))
        assert isinstance(moved.values, np.memmap)

    def test_give_the_same_hull(self, tmp_path):
        views = rigs.cameras(8, 48)
        silhouettes = [rigs.ball_silhouette(view) for view in views]
        one, _ = visual_hull(views, silhouettes, OPTIONS)
        other, _ = visual_hull(views, silhouettes, OPTIONS, scratch=tmp_path)
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.faces, other.faces)
        assert len(list(tmp_path.glob("distances*.npy"))) == len(views)

    def test_specks_are_removed_there_too(self, tmp_path):
        views = rigs.cameras(8, 64)
        silhouettes = [rigs.ball_silhouette(view) for view in views]
        silhouettes[3] = silhouettes[3].copy()
        silhouettes[3][2:4, 2:4] = 1.0
        cleaned = []
        for scratch in (None, tmp_path):
            measured = measured_views(views, silhouettes, scratch)
            kept, clean, removed = without_specks(measured, silhouettes, scratch)
            assert removed == {"v003": 1}
            assert clean[3][:6, :6].max() == 0.0
            assert clean[2] is silhouettes[2]
            cleaned.append(kept[3].outline.values)
        np.testing.assert_array_equal(*cleaned)
        # The caller's stay as they are.
        assert silhouettes[3][2, 2] == 1.0


def test_changed_silhouettes_are_made_when_asked_for():
    silhouettes = [np.array([[0.0, 0.25], [1.0, 0.5]], np.float32)]
    np.testing.assert_array_equal(Inverted(silhouettes)[0], [[1.0, 0.75], [0.0, 0.5]])
    cleaned = Cleaned(silhouettes, {0: np.array([1, 2])})
    np.testing.assert_array_equal(cleaned[0], [[0.0, 0.0], [0.0, 0.5]])
