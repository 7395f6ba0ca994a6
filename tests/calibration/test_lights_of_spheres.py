"""Lights found by their reflections in spheres that were drawn with known ones."""

import numpy as np
import pytest

from reflfield.api.light_calibration import light_references, lights_of_photographs
from reflfield.calibration.circles import Circle, find_circles, parse_circle
from reflfield.calibration.reference_lights import photographs_in, write_lights
from reflfield.capture.image_writing import write_exr, write_png
from reflfield.errors import InputError

SIZE = 240
LEFT, RIGHT, MATT = (
    Circle(60.0, 80.0, 40.0),
    Circle(180.0, 90.0, 40.0),
    Circle(120.0, 185.0, 38.0),
)


def sphere(circle):
    """Points, relative to the centre and in radii, and coverage of a sphere's pixels."""
    row, column = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5, indexing="ij")
    x, y = (column - circle.x) / circle.radius, (circle.y - row) / circle.radius
    square = x * x + y * y
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - square, 0))], axis=2)
    return normal, np.clip((1 - np.sqrt(square)) * circle.radius + 0.5, 0, 1)


def photograph(lamp, strength=1.0):
    """Two mirror spheres and a matt one under a lamp at (x, y, z), in radii of 40 pixels."""
    image = np.full((SIZE, SIZE), 0.02)
    for circle in (LEFT, RIGHT):
        normal, cover = sphere(circle)
        reflected = 2 * normal[..., 2:] * normal - [0, 0, 1]
        towards = lamp - (centre(circle) + normal)
        towards = towards / np.linalg.norm(towards, axis=2, keepdims=True)
        angle = np.arccos(np.clip((reflected * towards).sum(axis=2), -1, 1))
        shine = 0.005 + 5.0 * np.exp(-np.square(angle / np.radians(4)) / 2)
        image = image * (1 - cover) + shine * cover
    normal, cover = sphere(MATT)
    towards = lamp - centre(MATT) * [1, 1, 0]
    far = np.linalg.norm(towards)
    shade = 0.5 * strength * 100 / far**2 * np.maximum(normal @ (towards / far), 0)
    image = image * (1 - cover) + shade * cover
    return np.repeat(image[..., None], 3, axis=2).astype(np.float32)


def centre(circle):
    return np.array([circle.x - SIZE / 2, SIZE / 2 - circle.y, 0.0]) / 40.0


LAMPS = np.array([[4.0, 3.0, 9.0], [-5.0, 2.0, 8.0], [1.0, -6.0, 9.0], [0.5, 5.0, 11.0]])
STRENGTHS = (1.0, 1.0, 1.3, 0.6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("spheres")
    for number, (lamp, strength) in enumerate(zip(LAMPS, STRENGTHS, strict=True)):
        write_exr(path / f"l{number}.exr", photograph(lamp, strength))
    return path


def text(circle):
    return f"{circle.x},{circle.y},{circle.radius}"


def test_two_spheres_tell_positions_and_a_matt_one_intensities(folder, tmp_path):
    references = light_references([text(LEFT), text(RIGHT)], text(MATT))
    lights, _ = lights_of_photographs([folder], references)
    # The centre of a highlight is found to a tenth of a pixel: 0.3 degrees, doubled by the
    # reflection, over a base of three radii at ten.
    for light, lamp in zip(lights, LAMPS, strict=True):
        assert np.linalg.norm(light.position - lamp) < 0.06 * np.linalg.norm(lamp)
    intensities = np.array([light.intensity for light in lights])
    expected = np.array(STRENGTHS) / np.median(STRENGTHS)
    np.testing.assert_allclose(intensities, expected, rtol=0.12)  # twice that of the distance
    table, directions = write_lights(tmp_path, lights)
    assert table.read_text().splitlines()[0] == "name,x,y,z,intensity"
    assert table.read_text().splitlines()[1].startswith("l0.exr,")
    assert directions.read_text().splitlines()[0] == "4"


def test_one_sphere_tells_directions(folder):
    lights, _ = lights_of_photographs([folder], light_references([text(LEFT)]))
    for light, lamp in zip(lights, LAMPS, strict=True):
        towards = lamp - centre(LEFT)
        normal = light.direction + np.array([0, 0, 1])  # of the reflecting point
        towards = towards - normal / np.linalg.norm(normal)
        cosine = light.direction @ towards / np.linalg.norm(towards)
        assert np.degrees(np.arccos(cosine)) < 0.7
        assert light.position is None


def test_a_matt_sphere_alone_tells_directions(folder):
    lights, _ = lights_of_photographs([folder], light_references([], text(MATT)))
    for light, lamp in zip(lights, LAMPS, strict=True):
        towards = lamp - centre(MATT)
        sine = np.linalg.norm(np.cross(light.direction, towards))
        assert np.degrees(np.arctan2(sine, light.direction @ towards)) < 0.5


def test_spheres_are_found_by_themselves():
    images = [photograph(lamp)[..., 0] for lamp in LAMPS]
    circles = sorted(find_circles(images, 3), key=lambda circle: circle.x)
    # Half a pixel of edge on both sides; the dark side of the matt one has no edge.
    for circle, true, least in zip(circles, (LEFT, MATT, RIGHT), (0.7, 5, 0.7), strict=True):
        assert abs(circle.x - true.x) < least
        assert abs(circle.y - true.y) < least
        assert abs(circle.radius - true.radius) < least


@pytest.mark.parametrize("words", ["1,2", "a,b,c", "1,2,0", "1,2,nan"])
def test_what_is_no_circle_is_refused(words):
    with pytest.raises(InputError, match="sphere: expected"):
        parse_circle(words)


def test_a_sphere_without_a_highlight_is_refused_by_name(folder):
    with pytest.raises(InputError, match=r"l0\.exr: sphere: expected a"):
        lights_of_photographs([folder], light_references([text(MATT)]))


@pytest.mark.parametrize("circle", ["9,9,1e9", "9,9,1e300", "1e9,9,3", "9,9,1e-9"])
@pytest.mark.parametrize("kind", ["sphere", "matt_sphere"])
def test_circles_beyond_the_image_are_refused_at_once(folder, circle, kind):
    """Their blur would take gigabytes."""
    asked = {"spheres": [circle]} if kind == "sphere" else {"spheres": [], kind: circle}
    with pytest.raises(InputError, match="sphere: expected a circle in the image"):
        lights_of_photographs([folder], light_references(**asked))


def test_a_matt_sphere_that_is_saturated_is_refused(tmp_path):
    write_png(tmp_path / "a.png", np.full((SIZE, SIZE, 3), 255, np.uint8))
    with pytest.raises(InputError, match=r"a\.png: matt_sphere: .* 0 lit pixels"):
        lights_of_photographs([tmp_path], light_references([], matt_sphere=text(MATT)))


def test_a_table_of_others_stays(folder, tmp_path):
    lights, _ = lights_of_photographs([folder], light_references([text(LEFT)]))
    write_lights(tmp_path / "new", lights)
    (tmp_path / "lights.csv").write_text("from a drawing")
    with pytest.raises(InputError, match=r"lights\.csv: expected no such file"):
        write_lights(tmp_path, lights)
    assert (tmp_path / "lights.csv").read_text() == "from a drawing"


def test_given_directions_of_chrome_spheres_are_met(shared_data):
    folder = shared_data("psbox_probe")
    directions = []
    for probe, height in ((1, 1000), (2, 950)):
        x, y, radius = np.loadtxt(folder / f"LightProbe-{probe}/circle_data.txt").ravel()
        files = sorted((folder / f"LightProbe-{probe}").glob("Image_*.JPG"))
        references = light_references([f"{x},{height - y},{radius}"])
        lights, _ = lights_of_photographs(files, references)
        directions.append([light.direction for light in lights])
    mean = np.mean(directions, axis=0)
    stated = np.loadtxt(folder / "light_directions.txt").T
    cosine = (mean * stated).sum(axis=1) / np.linalg.norm(mean, axis=1)
    assert np.degrees(np.arccos(cosine)).max() < 1


@pytest.mark.parametrize(
    ("name", "value"),
    [("radius", 5e-324), ("radius", 0), ("radius", 1e300), ("focal", 5e-324), ("focal", -9)],
)
def test_lengths_beyond_their_range_are_refused(name, value):
    with pytest.raises(InputError, match=rf"{name}: expected a number of .* to 1e\+09"):
        light_references([text(LEFT)], **{name: value})


def test_a_focal_length_in_millimetres_is_refused(folder):
    with pytest.raises(InputError, match=r"focal: expected at least 60 pixels.*in millimetres"):
        lights_of_photographs([folder], light_references([text(LEFT)], focal=50))


@pytest.mark.parametrize("name", ["a\n.exr", "\x1b[2J.exr", " a.exr", "\udcff.exr"])
def test_names_that_cannot_stand_in_a_list_of_lights_are_refused(tmp_path, name):
    try:
        (tmp_path / name).touch()
    except OSError:
        pytest.skip("the file system has no such names")
    with pytest.raises(InputError, match="expected a name without control characters"):
        photographs_in([tmp_path])


def test_photographs_of_one_name_in_two_folders_are_refused(tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.exr").touch()
    with pytest.raises(InputError, match=r"two.a\.exr: expected names that differ"):
        photographs_in([tmp_path / "one", tmp_path / "two"])
