import numpy as np
import OpenEXR
import pytest

from reflfield.export.formats import export_field
from tests.viewer.shown_fields import clustered_field, half_vector_field


def layers(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


@pytest.mark.reference
def test_layers_hold_the_field_where_its_texels_are(tmp_path):
    """Read by OpenEXR's own library."""
    field = half_vector_field()
    (line,) = export_field(field, tmp_path / "a.exr", "exr")
    read = layers(tmp_path / "a.exr")
    assert set(line.removeprefix("channels: ").split()) == set(read)
    pixel = (5, 30)
    texel = field.texel_of_pixel[pixel]
    for name, row in (("normal", 2), ("tangent", 0)):
        values = [read[f"{name}.{axis}"][pixel] for axis in "XYZ"]
        np.testing.assert_array_equal(values, field.local_from_world[texel, row])
    np.testing.assert_array_equal(
        [read[f"weight.{k}"][pixel] for k in (1, 2)], field.half_vector.weights[texel]
    )
    assert (read["A"] == (field.texel_of_pixel >= 0)).all()
    # On a sphere around the origin the normal is the position, but for the facets: the middle
    # of a diagonal, whose ends are half of 7.5 degrees away in both angles.
    position = np.array([read[f"position.{axis}"][5, 3] for axis in "XYZ"])
    normal = np.array([read[f"normal.{axis}"][5, 3] for axis in "XYZ"])
    np.testing.assert_allclose(position, normal, rtol=0, atol=2 * np.radians(3.75) ** 2)


def test_a_clustered_field_has_clusters_and_coefficients(tmp_path):
    field = clustered_field()
    export_field(field, tmp_path / "a.exr", "exr")
    read = layers(tmp_path / "a.exr")
    texel = field.texel_of_pixel[7, 7]
    assert read["cluster.Y"][7, 7] == field.cluster[texel]
    assert read["coefficient.2"][7, 7] == field.coefficients[texel, 1]
