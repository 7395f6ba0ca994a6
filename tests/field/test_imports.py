"""Opening and evaluating a field imports no library that only making one needs."""

import json
import subprocess
import sys

import pytest

from reflfield.field.file import write_field
from tests.synthetic_fields import baked_field, lambert, square_surface

# Cluster, plots, rays and images: none of them serves a field that exists.
HEAVY = ("cv2", "dask", "distributed", "matplotlib", "open3d", "skimage", "trimesh", "zarr")
SCRIPT = """
import json, sys, time
start = time.perf_counter()
from reflfield.field.evaluation import evaluate
from reflfield.field.file import open_field
seconds = time.perf_counter() - start
up = [[0.0, 0.0, 1.0]]
value = float(evaluate(open_field(sys.argv[1]), [0], up, up)[0, 0])
print(json.dumps({"modules": sorted(sys.modules), "seconds": seconds, "value": value}))
"""


def test_opening_and_evaluating_a_field_imports_little(tmp_path):
    path = tmp_path / "field.rfld"
    write_field(path, baked_field(square_surface(2), lambert(0.5)))
    ended = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(path)], capture_output=True, text=True, check=True
    )
    found = json.loads(ended.stdout)
    print(f"imports of a field: {found['seconds']:.2f} s")
    assert found["value"] == pytest.approx(0.5 / 3.14159265, rel=1e-4)
    assert {name for name in found["modules"] if name in HEAVY} == set()
    # .5 s on an idle core; a busy machine takes several times that.
    assert found["seconds"] < 10.0
