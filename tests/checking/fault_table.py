"""The planted faults, each with the kinds of finding that name it and whom it concerns."""

from collections.abc import Callable
from dataclasses import dataclass

from tests.checking import faults as f


@dataclass(frozen=True)
class Fault:
    """A way to damage a capture.

    Parameters
    ----------
    plant : callable
        ``plant(planted, rng)``; returns the names that the finding must have (may be empty).
    kinds : tuple of str
        Kinds of finding of which one names it rightly.
    """

    plant: Callable
    kinds: tuple[str, ...]


def masks(count):
    ways = (f.shifted, f.cut_off, f.with_blob, lambda c: 1 - c, lambda c: c[:, ::-1] ** 0)

    def plant(planted, rng):
        n_views = len(planted.document["cameras"])
        views = rng.choice(n_views, count, replace=False)
        for view, way in zip(views, (ways * 2)[:count], strict=True):
            planted.change_mask(int(view), f.shifted if way is ways[4] else way)
        return planted.names("cameras", *views)

    return plant


def one_mask(change):
    def plant(planted, rng):
        view = int(rng.integers(len(planted.document["cameras"])))
        planted.change_mask(view, change)
        return planted.names("cameras", view)

    return plant


def every_mask(change):
    def plant(planted, rng):
        for view in range(len(planted.document["cameras"])):
            planted.change_mask(view, change)
        return ()

    return plant


def dilated(pixels):
    return lambda coverage: f.cv2.dilate(coverage, f.disc(pixels))


def turned_camera(planted, rng):
    view = int(rng.integers(len(planted.document["cameras"])))
    axis = [1.0, 0.0, 0.0] if rng.random() < 0.5 else [0.0, 1.0, 0.0]
    f.turn_camera(planted, view, axis)
    return planted.names("cameras", view)


def swapped_photographs(planted, rng):
    """Of two pairs whose views see the object lit."""
    pairs = lit_pairs(planted)
    first, second = (pairs[i] for i in rng.choice(len(pairs), 2, replace=False))
    f.swap_files(planted.photograph(*first), planted.photograph(*second))
    return (planted.photograph(*first).stem, planted.photograph(*second).stem)


def lit_pairs(planted):
    """Pairs whose camera and light are on one side of the object, not the lowest ring."""
    import numpy as np

    document = planted.document
    lights = np.array([light["position"] for light in document["lights"]])
    poses = np.array([camera["camera_from_world"] for camera in document["cameras"]])
    centres = -np.einsum("nij,ni->nj", poses[:, :3, :3], poses[:, :3, 3])
    middle = np.array([0, 0, 0.1])
    lights, centres = lights - middle, centres - middle
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    return [tuple(map(int, pair)) for pair in np.argwhere(centres @ lights.T > 0.3)]


def swapped_lights(planted, rng):
    first, second = rng.choice(len(planted.document["lights"]), 2, replace=False)
    f.swap_lights(planted, int(first), int(second))
    return planted.names("lights", first, second)


def dead_light(planted, rng):
    light = int(rng.integers(len(planted.document["lights"])))
    f.kill_light(planted, light, rng)
    return planted.names("lights", light)


def light_off(factor):
    def plant(planted, rng):
        light = int(rng.integers(len(planted.document["lights"])))
        f.scale_intensity(planted, light, factor)
        return planted.names("lights", light)

    return plant


def mirrored_lights(planted, rng):
    f.mirror_lights(planted, int(rng.integers(2)))
    return ()


def inverse_poses(planted, rng):
    f.invert_poses(planted, range(len(planted.document["cameras"])))
    return ()


def inverse_pose(planted, rng):
    view = int(rng.integers(len(planted.document["cameras"])))
    f.invert_poses(planted, [view])
    return planted.names("cameras", view)


def focal(factor):
    def plant(planted, rng):
        f.scale_focal(planted, range(len(planted.document["cameras"])), factor)
        return ()

    return plant


def one_focal(factor):
    def plant(planted, rng):
        view = int(rng.integers(len(planted.document["cameras"])))
        f.scale_focal(planted, [view], factor)
        return planted.names("cameras", view)

    return plant


def saturated(planted, rng):
    f.overexpose(planted, 0.2)
    return ()


def turned_photograph(turns):
    def plant(planted, rng):
        pairs = lit_pairs(planted)
        view, light = pairs[int(rng.integers(len(pairs)))]
        planted.change_photograph(view, light, lambda image: f.np.rot90(image, turns))
        return (planted.photograph(view, light).stem,)

    return plant


OF_MASKS = ("wrong mask",)
FAULTS = {
    "1 wrong mask": Fault(masks(1), OF_MASKS),
    "3 wrong masks": Fault(masks(3), OF_MASKS),
    "5 wrong masks": Fault(masks(5), OF_MASKS),
    "hole in a mask": Fault(one_mask(f.with_hole), ("hole in a mask",)),
    "one mask 3 px too large": Fault(one_mask(dilated(3)), ("mask too large", "wrong mask")),
    "all masks 3 px too large": Fault(every_mask(dilated(3)), ("all masks too large",)),
    "camera turned by 1 degree": Fault(turned_camera, ("turned camera",)),
    "two photographs swapped": Fault(swapped_photographs, ("swapped photographs",)),
    "two lights swapped": Fault(swapped_lights, ("swapped lights",)),
    "dead light": Fault(dead_light, ("dead light",)),
    "light 30 % too strong": Fault(light_off(1 / 1.3), ("bright light",)),
    "light 30 % too weak": Fault(light_off(1 / 0.7), ("dim light",)),
    "lights mirrored": Fault(mirrored_lights, ("axes of lights",)),
    "all poses inverse": Fault(inverse_poses, ("convention of poses",)),
    "one pose inverse": Fault(inverse_pose, ("pose of a camera",)),
    "focal lengths 5 % too long": Fault(focal(1.05), ("focal length",)),
    "focal lengths 5 % too short": Fault(focal(0.95), ("focal length",)),
    "one focal length 5 % too long": Fault(one_focal(1.05), ("focal length of a camera",)),
    "saturated exposures": Fault(saturated, ("overexposed photographs",)),
    "photograph turned by 90 degrees": Fault(turned_photograph(1), ("turned photograph",)),
    "photograph turned by 180 degrees": Fault(turned_photograph(2), ("turned photograph",)),
}
