"""Opening and rendering a field imports nothing that is slow and not needed for it."""

import subprocess
import sys

SLOW = ("cv2", "dask", "distributed", "matplotlib", "open3d", "open3d.cpu.pybind", "pandas",
        "scipy.linalg", "skimage", "sklearn", "trimesh", "zarr")  # fmt: skip

RENDERING = "reflfield.field.file, reflfield.render.renderer, reflfield.render.turntable"


def test_rendering_imports_no_slow_package():
    script = f"import sys, {RENDERING}; print(*(set({SLOW}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert done.stdout.split() == []
