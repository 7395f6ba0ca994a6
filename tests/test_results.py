"""Figures in the pages have files behind them, and pages are short and agree with the code."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(Path(__file__).parent))

from benchmarks import error_against_time, make_results, measuring  # noqa: E402
from test_layers import PACKAGES  # noqa: E402

from reflfield.pipeline.stages import ORDER, STAGES  # noqa: E402

README = ROOT / "README.md"
PIPELINE = ROOT / "reflfield" / "pipeline" / "README.md"
FOLDERS = ("reflfield", "capture_sim", "tests")
PAGES = [README, *(path for top in FOLDERS for path in sorted((ROOT / top).rglob("README.md")))]
# Files that captures and runs consist of.
WRITTEN = {
    *("capture.json", "transforms.json", "transforms_train.json", "transforms_test.json"),
    *("transforms_val.json", "header.json", "metrics.json", "timings.json", "options.toml"),
    *("OUT/timings.json", "OUT/options.toml", "report/index.html"),
    *("reflfield_bsdf.py", "render.py", "info.json", "build_object.py"),
    *("DIR/check.json", "DIR/index.html", "check.json", "tradeoff.json", "calibration.json"),
    *("truth/effects.json", "truth/rig.json", "results/NAME.json"),
}
# A measured figure: a number with the unit of a quality, a size or a time.
FIGURE = re.compile(r"\d\s?(dB|ms|s|min|kB|MB|GB|%|degrees?|seconds?|minutes?)(?![\w/])")


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Function that writes results of one module into a folder of their own."""
    monkeypatch.setenv(measuring.ELSEWHERE, str(tmp_path))

    def write(name="trial", modules=("reflfield.sphere.rotations",)):
        one = measuring.Results(name, "A trial", modules)
        one.table("Times")
        one.add({"method": "ours", "ms": 1.23456, "error": None})
        return one.write()

    return write


def outside_the_table(text):
    """The README without its table of results, options and commands."""
    before, _, rest = text.partition(make_results.BEGIN)
    text = before + rest.partition(make_results.END)[2]
    text = re.sub(r"^ {4}.*$", "", text, flags=re.MULTILINE)
    return re.sub(r"`[^`]*`", "", text)


@pytest.mark.parametrize("path", [make_results.PAGE, README], ids=lambda path: path.name)
def test_pages_are_what_the_command_makes_of_the_files(path):
    wanted = make_results.pages(make_results.load_results())[path]
    same = make_results.without_marks(path.read_text()) == make_results.without_marks(wanted)
    assert same, "run python tests/benchmarks/make_results.py"


def test_readme_has_no_figure_outside_of_its_table():
    text = outside_the_table(README.read_text())
    assert [match.group() for match in FIGURE.finditer(text)] == []


@pytest.mark.parametrize("said", ["27.2 dB", "in 3 minutes", "326 kB", "7 s", "1.4GB.", "10 %"])
def test_a_figure_is_told_from_other_numbers(said):
    assert FIGURE.search(said)
    assert not FIGURE.search("Python 3.11, 2 views, [1.0, 1.0], W/sr, 2006")
    assert FIGURE.search(outside_the_table(f"a\n{said}\n"))
    assert not FIGURE.search(outside_the_table(f"a\n    {said}\n`{said}`"))


def test_readme_is_short():
    lines = README.read_text().splitlines()
    # Two lines are left for the mark of figures that are older than their code.
    assert len(make_results.without_marks(README.read_text()).splitlines()) <= 148
    assert len(lines) <= 150
    assert max(map(len, lines)) < 120


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.parent.name)
def test_pages_beside_the_code_are_no_longer_than_the_readme(page):
    assert len(page.read_text().splitlines()) <= 150


@pytest.mark.parametrize(
    "path",
    sorted((ROOT / "tests" / "benchmarks").glob("bench_*.py")),
    ids=lambda path: path.stem,
)
def test_a_benchmark_writes_its_results_and_stands_on_the_page(path):
    source = path.read_text()
    assert re.search(r"\bResults\(", source)
    assert ".write(" in source
    assert f"tests/benchmarks/{path.name}" in (path.parent / "README.md").read_text()


def names_in_table(text):
    """Names in the first column of the first table of a text."""
    table = re.search(r"(^\|.*\n)+", text, re.MULTILINE).group()
    first = [line.split("|")[1] for line in table.splitlines()[2:]]
    return [name for cell in first for name in re.findall(r"`([\w_]+)/?`", cell)]


def test_layers_of_the_page_are_those_of_the_code():
    page = PIPELINE.read_text()
    assert names_in_table(page.partition("## Packages")[2]) == list(PACKAGES)


def test_stages_of_the_page_are_those_of_the_code():
    assert names_in_table(PIPELINE.read_text()) == list(STAGES)


def test_functions_of_the_stages_stand_where_the_page_says():
    table = re.search(r"(^\|.*\n)+", PIPELINE.read_text(), re.MULTILINE).group()
    linked = re.findall(r"\[(\w+)\]\((\S+\.py)\)", table)
    sources = {link: (PIPELINE.parent / link).read_text() for _, link in linked}
    missing = [
        (name, link)
        for name, link in linked
        if not re.search(rf"^(def|class) {name}\b", sources[link], re.MULTILINE)
    ]
    assert linked
    assert missing == []


@pytest.mark.parametrize("stage", ORDER, ids=lambda stage: stage.name)
def test_a_stage_begins_in_the_module_of_its_name(stage):
    module = stage.compute.__module__.rpartition(".")[2]
    elsewhere = {"model_selection": "stages"}
    elsewhere |= dict.fromkeys((n for n in STAGES if n.startswith("surface_")), "surface")
    assert module == elsewhere.get(stage.name, stage.name)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.parent.name)
def test_pages_name_files_that_exist(page):
    text = page.read_text()
    named = re.findall(r"`([\w/.-]+\.(?:py|json|md|toml))`", text)
    linked = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    places = (page.parent, ROOT, ROOT / "tests" / "benchmarks", page.parent / "schema")
    missing = [
        name
        for name in (*named, *linked)
        if name not in WRITTEN and not any((place / name).is_file() for place in places)
    ]
    assert missing == []


def test_a_file_of_results_says_how_it_came_about(results):
    content = json.loads(results().read_text())
    assert set(content) == set(measuring.KEYS)
    assert content["command"].startswith("python ")
    assert content["machine"]["cores"] >= 1
    assert content["machine"]["memory_gb"] > 0.1
    assert content["versions"]["numpy"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", content["date"])
    assert content["tables"][0]["rows"] == [{"method": "ours", "ms": 1.23456, "error": None}]


def test_results_of_a_module_that_does_not_exist_are_refused(results):
    with pytest.raises(ValueError, match=r"received 'reflfield\.nothing'"):
        results(modules=("reflfield.nothing",))


def test_a_cell_is_text_or_a_number():
    with pytest.raises(TypeError, match="received list"):
        measuring.plain([1.0])
    assert measuring.plain(float("inf")) == "inf"


def test_figures_older_than_their_code_are_marked(results):
    path = results()
    (new,) = make_results.load_results(path.parent)
    assert make_results.marks(make_results.page([new])) == []
    content = json.loads(path.read_text())
    content["code"]["reflfield.sphere.rotations"] = "0" * 64
    path.write_text(json.dumps(content))
    (old,) = make_results.load_results(path.parent)
    marked = make_results.page([old])
    assert [line.split(":")[0] for line in make_results.marks(marked)] == ["A trial"]
    assert "`reflfield.sphere.rotations`" in make_results.mark(old)[0]
    # The mark is all that differs, and does not count.
    assert marked != make_results.page([new])
    assert make_results.without_marks(marked) == make_results.page([new])


def test_code_of_another_python_is_not_compared(results):
    path = results()
    content = json.loads(path.read_text())
    content["versions"]["python"] = "3.1.0"
    assert "not known: measured with Python 3.1.0" in make_results.mark(content)[0]


def test_a_file_without_what_it_must_say_is_refused(results):
    path = results()
    content = json.loads(path.read_text())
    del content["machine"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="expected machine"):
        make_results.load_results(path.parent)


def test_the_table_goes_between_two_comments():
    text = f"a\n{make_results.BEGIN}\nold\n{make_results.END}\nb\n"
    assert make_results.with_table(text, "new\n") == text.replace("old", "new")
    with pytest.raises(ValueError, match="expected one"):
        make_results.with_table("a\n", "new\n")


def test_check_says_what_is_not_as_made():
    script = ROOT / "tests" / "benchmarks" / "make_results.py"
    done = subprocess.run(
        [sys.executable, str(script), "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_pictures_show_error_against_time_for_what_was_measured():
    rows = [
        {"method": "Brand, block 64, 2 passes", "error": 0.01, "CPU, s": 2.0},
        {"method": "Brand, block 64, 1 pass", "error": 0.1, "CPU, s": 1.0},
        {"method": "(bound: known)", "error": 0.001, "CPU, s": 1.0},
    ]
    tables = [{"title": "completion, hemispheric, 9 x 8", "rows": rows}]
    drawn = error_against_time.pictures([{"name": "factorization", "tables": tables}])
    assert list(drawn) == ["factorization.svg"]
    assert drawn["factorization.svg"].startswith("<?xml")
    none = [{"name": "factorization", "tables": [{"title": "local PCA", "rows": []}]}]
    assert error_against_time.pictures(none) == {}


def test_fits_are_joined_from_the_papers_to_the_default():
    """An order by time would join a slow poor method to a fast good one."""
    rows = [
        {"capture": "vase", "images": images, "method": m, "PSNR, dB": 1.0, "CPU time, s": 1.0}
        for images in ("unseen", "held out")
        for m in ("default", "half vector, samples", "clusters, not aligned", "paper")
    ]
    curves = error_against_time.fit_curves(rows)
    assert {images for _, images in curves} == {"unseen views and lights", "held out"}
    for points in curves.values():
        assert [m for m, *_ in points] == ["paper", "half vector, samples", "default"]
    assert b"<svg" in error_against_time.fit_picture([{"rows": rows}])
    others = [row for row in rows if row["method"] == "default"]
    assert error_against_time.fit_picture([{"rows": others}]) is None


def test_searches_are_drawn_for_each_band_limit():
    rows = [
        {"L": limit, "search": search, "K or rounds": "4", "ms per texel": 1.0 + limit}
        | {"normals": 1.0, "tangents": 2.0, "remark": "the default"}
        for limit in (4, 8)
        for search in error_against_time.SEARCHES
    ]
    tables = [{"title": "", "rows": rows}]
    drawn = error_against_time.pictures([{"name": "accuracy", "tables": tables}])
    assert drawn == error_against_time.pictures([{"name": "accuracy", "tables": tables}])
    assert list(drawn) == ["accuracy.svg"]
    assert error_against_time.alignment_picture(tables, "png").startswith(b"\x89PNG")
