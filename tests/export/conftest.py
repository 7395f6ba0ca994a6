"""A browser, and OpenLIME in it."""

import pytest

from tests.export.openlime import openlime_images, openlime_script
from tests.viewer.conftest import browser as browser


@pytest.fixture
def openlime(request, tmp_path):
    """Function from a folder, lights and a mode to images; skips where OpenLIME is absent."""
    if openlime_script() is None:
        pytest.skip("needs OpenLIME (set OPENLIME to its script, as dist/js/openlime.js)")
    browser = request.getfixturevalue("browser")
    return lambda folder, lights, mode="light": openlime_images(
        browser, folder, tmp_path / mode, lights, mode
    )
