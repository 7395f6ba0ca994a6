"""Nothing in the packages that no command and no public function reaches.

Two checks by text alone: `vulture` names what no other code of the packages mentions (tests,
examples and doctests do not count; names in ``__all__`` do), and the graph of imports says
which modules the commands and the public API import.
"""

from pathlib import Path

import pytest
from vulture import Vulture

from tests.test_layers import ROOT, imports_in, modules

PACKAGES = ("reflfield", "capture_sim")
# Functions that a decorator hands to a command line or a library.
DECORATORS = ["@*.command", "@*.callback", "@app.*"]
# What vulture names although it is used: path, name, reason.
ALLOWED = {
    ("capture_sim/effects/lens_distortion.py", "k1"): "read by the names in _TERMS",
    ("capture_sim/effects/lens_distortion.py", "k2"): "read by the names in _TERMS",
    ("capture_sim/effects/lens_distortion.py", "k3"): "read by the names in _TERMS",
    ("capture_sim/effects/lens_distortion.py", "p1"): "read by the names in _TERMS",
    ("capture_sim/effects/lens_distortion.py", "p2"): "read by the names in _TERMS",
    ("capture_sim/files.py", "compress_type"): "zipfile reads it",
    ("capture_sim/objects/gltf.py", "data"): "argument that trimesh passes by name",
    ("capture_sim/objects/gltf.py", "namespaced"): "trimesh calls it",
    ("reflfield/__init__.py", "__dir__"): "Python calls it",
    ("reflfield/__init__.py", "__getattr__"): "Python calls it",
    ("reflfield/field/file.py", "create_system"): "zipfile reads it",
    ("reflfield/field/file.py", "external_attr"): "zipfile reads it",
    ("reflfield/geometry/xatlas_worker.py", "texels_per_unit"): "xatlas reads its options",
    ("reflfield/geometry/xatlas_worker.py", "bilinear"): "xatlas reads its options",
    ("reflfield/geometry/xatlas_worker.py", "bruteForce"): "xatlas reads its options",
    ("reflfield/sphere/coupling.py", "writeable"): "NumPy reads the flag",
    ("reflfield/util/blas_threads.py", "n_modules"): "argument of a context manager's factory",
    ("reflfield/pipeline/cache.py", "blocks_computed"): "written into the record of a stage",
    ("reflfield/pipeline/cache.py", "blocks_resumed"): "written into the record of a stage",
    ("reflfield/pipeline/cache.py", "blocks_repeated"): "written into the record of a stage",
    ("reflfield/export/blender_scene/build_object.py", "default_value"): "Blender reads it",
    ("reflfield/export/blender_scene/build_object.py", "direction_type"): "Blender reads it",
    ("reflfield/export/blender_scene/build_object.py", "distribution"): "Blender reads it",
    ("reflfield/export/blender_scene/build_object.py", "interpolation"): "Blender reads it",
    ("reflfield/export/blender_scene/build_object.py", "operation"): "Blender reads it",
    ("reflfield/export/blender_scene/build_object.py", "use_nodes"): "Blender reads it",
    ("reflfield/export/blender_scene/build_object.py", "uv_map"): "Blender reads it",
    ("reflfield/export/mitsuba_scene/reflfield_bsdf.py", "eta"): "Mitsuba reads it",
    ("reflfield/export/mitsuba_scene/reflfield_bsdf.py", "m_components"): "Mitsuba reads it",
    ("reflfield/export/mitsuba_scene/reflfield_bsdf.py", "m_flags"): "Mitsuba reads it",
    (
        "reflfield/export/mitsuba_scene/reflfield_bsdf.py",
        "sampled_component",
    ): "Mitsuba reads it",
    ("reflfield/export/mitsuba_scene/reflfield_bsdf.py", "sampled_type"): "Mitsuba reads it",
    ("reflfield/export/mitsuba_scene/reflfield_bsdf.py", "to_string"): "Mitsuba reads it",
    ("reflfield/viewer/page_server.py", "args"): "argument of a method of the library",
    ("reflfield/viewer/page_server.py", "daemon_threads"): "socketserver reads it",
    ("reflfield/viewer/page_server.py", "do_GET"): "http.server calls it",
    ("reflfield/viewer/page_server.py", "log_message"): "http.server calls it",
    ("reflfield/observations/store.py", "_end_thread_of_zarr"): "run at the process's end",
}
# Attributes and methods that are promised to users: `test_public_api` keeps the list.
PROMISED = {
    line.split("(")[0].partition(".")[2]
    for line in (ROOT / "tests/data/public_api.txt").read_text().splitlines()
}
# Modules that are started as processes, or copied for other software, and not imported.
PROCESSES = {
    *("reflfield.__main__", "capture_sim.__main__", "reflfield.geometry.xatlas_worker"),
    "reflfield.tradeoff.measured_run",
    "reflfield.export.blender_scene.build_object",
    *(f"reflfield.export.mitsuba_scene.{name}" for name in ("reflfield_bsdf", "render")),
}


def unmentioned(folder, paths):
    """(path, name) of what nothing in the paths mentions."""
    vulture = Vulture(ignore_decorators=DECORATORS)
    vulture.scavenge([str(folder / path) for path in paths])
    return {
        (Path(item.filename).relative_to(folder).as_posix(), item.name)
        for item in vulture.get_unused_code(min_confidence=60)
        if item.name not in PROMISED
    }


def name_of(path):
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_from(roots, graph):
    """Modules that roots import, directly or through others."""
    reached, left = set(), list(roots)
    while left:
        module = left.pop()
        if module not in reached:
            reached.add(module)
            left += graph.get(module, ())
    return reached


def test_every_name_is_mentioned_by_other_code():
    # One package at a time: names of one do not excuse the other's.
    unused = {item for package in PACKAGES for item in unmentioned(ROOT, [package])}
    assert sorted(unused - set(ALLOWED)) == []
    assert sorted(set(ALLOWED) - unused) == [], "no longer needed in the list"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_module_is_imported_by_the_commands_or_the_api(package):
    paths = {name_of(path): path for path in modules(package)}
    graph = {}
    for module, path in paths.items():
        imported = {one.module for one in imports_in(path)}
        # "from module import name" and "from package import module".
        imported |= {name.rpartition(".")[0] for name in imported}
        graph[module] = imported & set(paths)
    roots = {package} | {name for name in PROCESSES if name in paths}
    reached = imported_from(roots, graph)
    packages = {name for name, path in paths.items() if path.stem == "__init__"}
    assert sorted(set(paths) - reached - packages) == []


def test_the_checks_see_what_they_must(tmp_path):
    (tmp_path / "one.py").write_text(
        '"""Doctests are no use.\n\n>>> tested()\n"""\n__all__ = ["public"]\n'
        "def public():\n    return helper()\n"
        "def helper():\n    return 1\n"
        "def tested():\n    return 2\n"
    )
    assert unmentioned(tmp_path, ["one.py"]) == {("one.py", "tested")}
    graph = {"a": ["b"], "b": ["c", "a"], "d": ["b"]}
    assert imported_from({"a"}, graph) == {"a", "b", "c"}
