"""A tiny dome that several tests photograph a ball with: a run of it takes seconds."""


def ball_scene(name, material=None, n_lights=(4, 2), **others):
    """Scene of a ball seen by 10 cameras of 32 x 32 pixels.

    Parameters
    ----------
    name : str
    material : dict, optional
        Table of the scene; satin by default.
    n_lights : tuple of int
        Lamps of the lower and of the upper ring.
    **others
        Further tables of the scene.
    """
    return {
        "name": name,
        "object": {"preset": "sphere", "radius": 0.05},
        "material": material or {"preset": "satin"},
        "cameras": {
            "preset": "rings",
            "elevations_deg": [-30, 10, 50],
            "counts": [3, 4, 3],
            "offsets_deg": [0, 30, 0],
            "distance": 0.5,
            "extent": 0.13,
            "width": 32,
            "height": 32,
        },
        "lights": {
            "preset": "rings",
            "elevations_deg": [10, 60],
            "counts": list(n_lights),
            "distance": 0.6,
        },
        "image": {"samples_per_side": 1, "edge_samples_per_side": 2},
        **others,
    }
