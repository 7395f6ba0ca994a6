"""Captures with one planted fault each, made from a clean simulated one."""

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from reflfield.capture.image_files import read_coverage, read_image
from reflfield.capture.image_writing import write_exr


@dataclass
class Planted:
    """A copy of a capture to damage: files are links to the original's until written."""

    folder: Path

    @classmethod
    def copy(cls, clean, folder):
        shutil.copytree(
            clean, folder, copy_function=os.link, ignore=shutil.ignore_patterns("truth")
        )
        return cls(folder)

    @property
    def document(self):
        return json.loads((self.folder / "capture.json").read_text())

    def describe(self, change):
        document = self.document
        change(document)
        (self.folder / "capture.json").unlink()
        (self.folder / "capture.json").write_text(json.dumps(document))

    def photograph(self, view, light):
        camera, lamp = (
            self.document["cameras"][view]["id"],
            self.document["lights"][light]["id"],
        )
        return self.folder / f"photographs/{camera}_{lamp}.exr"

    def mask(self, view):
        return self.folder / self.document["cameras"][view]["silhouette"]

    def change_mask(self, view, change):
        path = self.mask(view)
        coverage = np.clip(change(read_coverage(path)), 0, 1)
        path.unlink()
        cv2.imwrite(str(path), np.rint(255 * coverage).astype(np.uint8))

    def change_photograph(self, view, light, change):
        path = self.photograph(view, light)
        image = change(read_image(path))
        path.unlink()
        write_exr(path, np.ascontiguousarray(image, np.float32))

    def all_photographs(self):
        n_views, n_lights = (len(self.document[key]) for key in ("cameras", "lights"))
        return [(v, light) for v in range(n_views) for light in range(n_lights)]

    def names(self, key, *numbers):
        return tuple(self.document[key][number]["id"] for number in numbers)


def disc(radius):
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def shifted(coverage):
    return np.roll(coverage, round(0.1 * coverage.shape[1]), axis=1)


def cut_off(coverage):
    rows = np.flatnonzero((coverage > 0.5).any(axis=1))
    cut = coverage.copy()
    cut[: rows[len(rows) // 4]] = 0
    return cut


def with_blob(coverage):
    blob = np.zeros_like(coverage)
    height, width = coverage.shape
    columns = np.flatnonzero((coverage > 0.5).any(axis=0))
    x = min(columns[-1] + 1, width - width // 8)
    cv2.circle(blob, (int(x), height // 2), max(3, width // 12), 1.0, -1)
    return np.maximum(coverage, blob)


def with_hole(coverage):
    distance = cv2.distanceTransform((coverage > 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    row, column = np.unravel_index(distance.argmax(), distance.shape)
    hole = np.zeros_like(coverage)
    radius = max(2, int(0.45 * distance.max()))
    cv2.circle(hole, (int(column), int(row)), radius, 1.0, -1)
    return np.minimum(coverage, 1 - hole)


def turn_camera(planted, view, vector_deg):
    def change(document):
        pose = np.array(document["cameras"][view]["camera_from_world"])
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(np.radians(vector_deg)).as_matrix()
        document["cameras"][view]["camera_from_world"] = (turn @ pose).tolist()

    planted.describe(change)


def scale_focal(planted, views, factor):
    def change(document):
        for view in views:
            for key in ("fl_x", "fl_y"):
                document["cameras"][view][key] *= factor

    planted.describe(change)


def invert_poses(planted, views):
    def change(document):
        for view in views:
            pose = np.array(document["cameras"][view]["camera_from_world"])
            document["cameras"][view]["camera_from_world"] = np.linalg.pinv(pose).tolist()

    planted.describe(change)


def swap_files(first, second):
    spare = first.with_suffix(".spare")
    first.rename(spare)
    second.rename(first)
    spare.rename(second)


def swap_lights(planted, first, second):
    def change(document):
        lights = document["lights"]
        for key in ("position", "direction"):
            if key in lights[first]:
                lights[first][key], lights[second][key] = (
                    lights[second][key],
                    lights[first][key],
                )

    planted.describe(change)


def scale_intensity(planted, light, factor):
    def change(document):
        entry = document["lights"][light]
        key = "intensity" if "intensity" in entry else "irradiance"
        entry[key] = (factor * np.array(entry[key])).tolist()

    planted.describe(change)


def mirror_lights(planted, axis):
    def change(document):
        for light in document["lights"]:
            for key in ("position", "direction"):
                if key in light:
                    light[key][axis] *= -1

    planted.describe(change)


def kill_light(planted, light, rng):
    for view, lamp in planted.all_photographs():
        if lamp == light:
            planted.change_photograph(
                view,
                lamp,
                lambda image: (
                    np.maximum(rng.normal(0, 1e-4, image.shape), 0) * np.float32(image.max())
                ),
            )


def overexpose(planted, share):
    for view, lamp in planted.all_photographs():

        def clipped(image):
            lit = image[image > 0.02 * image.max()] if image.max() > 0 else image
            white = np.quantile(lit, 1 - share)
            return np.minimum(image / max(white, 1e-9), 1)

        planted.change_photograph(view, lamp, clipped)
