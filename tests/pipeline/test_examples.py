"""The example scripts run as their own text says."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def test_process_and_relight(tiny_capture, tiny_options, subprocess_run, tmp_path):
    script = EXAMPLES / "process_and_relight.py"
    done = subprocess_run(
        script, tiny_capture, tmp_path, "--config", tiny_options, "--size", 64
    )
    assert done.status == 0, done.err
    picture = np.asarray(Image.open(done.out.strip().splitlines()[-1]))
    assert picture.shape == (64, 64, 3)
    # The ball stands in the middle, lit; the corners are empty.
    assert picture[28:36, 28:36].mean() > 20
    assert not picture[:4, :4].any()


@pytest.mark.slow
def test_align_synthetic_btf(subprocess_run):
    done = subprocess_run(EXAMPLES / "align_synthetic_btf.py", "--texels", 300)
    assert done.status == 0, done.err
    assert "normals" in done.out.lower()
