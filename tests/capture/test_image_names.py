"""Names of image files in other encodings, which the libraries take in UTF-8 alone."""

import numpy as np
import pytest

from reflfield.capture.image_files import read_image
from reflfield.capture.image_writing import write_exr
from reflfield.errors import CaptureError, InputError

IMAGE = np.full((4, 5, 3), 0.25, np.float32)


def test_name_read_under_another_locale_is_the_file(tmp_path):
    """LANG=C has the two bytes of an accented letter as two halves of surrogate pairs."""
    name = "vas\xe9.exr"
    surrogates = name.encode().decode("ascii", "surrogateescape")
    write_exr(tmp_path / name, IMAGE)
    np.testing.assert_array_equal(read_image(tmp_path / surrogates), IMAGE)
    (tmp_path / name).unlink()
    write_exr(tmp_path / surrogates, IMAGE)
    np.testing.assert_array_equal(read_image(tmp_path / name), IMAGE)


def test_name_that_is_no_utf8_is_said_not_to_be(tmp_path):
    write_exr(tmp_path / "a.exr", IMAGE)
    latin = tmp_path / "vas\udce9.exr"
    (tmp_path / "a.exr").rename(latin)
    with pytest.raises(CaptureError, match="expected a name in UTF-8"):
        read_image(latin)
    with pytest.raises(InputError, match="expected a name in UTF-8"):
        write_exr(latin, IMAGE)
