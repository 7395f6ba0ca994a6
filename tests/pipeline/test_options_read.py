"""What a stage reads of the options is part of its key, or of the key of a stage before it.

An option that is read and not in the key is changed without effect: the earlier result stays.
"""

import sys
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import wraps

import pytest

from capture_sim.scene import parse_scene
from capture_sim.write import write_capture
from reflfield.capture.readers import open_capture
from reflfield.options import HoldOut, Resources, with_tables
from reflfield.pipeline import stages
from reflfield.pipeline.pipeline_options import PipelineOptions
from reflfield.pipeline.stage import Stage

# Runs that are short and of all stages.
QUICK = {
    "hull": {"resolution": 32, "n_triangles": 2000},
    "atlas": {"resolution": 48},
    "resampling": {"view_side": 5, "light_side": 5},
    "completion": {"rank": 4, "passes": 1},
    "alignment": {"band_limit": 4, "iterations": 1},
    "compression": {"rank": 4, "n_clusters": 2, "n_components": 2},
    "relighting": {"samples_per_pixel": 1},
    "comparison": {"without_alignment": True, "rate_distortion": True},
}
SHORT_FIT = {"rounds": 1, "iterations": 2}
FLAT = {
    "base_geometry": "plane",
    "effects": ["near_lights"],
    "object": {"preset": "relief"},
    "material": {"preset": "satin"},
    "cameras": {
        "preset": "rti",
        "model": "orthographic",
        "extent": 0.18,
        "width": 16,
        "height": 16,
    },
    "lights": {"preset": "rti", "n": 24, "max_inclination_deg": 75, "distance": 0.5},
    "image": {"samples_per_side": 1, "edge_samples_per_side": 1},
}
SAMPLES = {"model": "clustered", "fit": "samples", "samples": SHORT_FIT}
MODELS = {
    "samples": {"compression": SAMPLES},
    "grid": {"compression": {"model": "clustered", "fit": "grid"}},
    "base frames": {"compression": SAMPLES, "alignment": {"enabled": False}},
    "half vector": {
        "compression": {"model": "half_vector", "half_vector": {"n_lobes": 1}},
        "comparison": {"without_alignment": False},
    },
    "auto": {"compression": {"samples": SHORT_FIT}},
}


@dataclass
class Reads:
    """Options that are read, as "CLASS.FIELD", while a set stands ready for them."""

    names: set | None = None
    computing: bool = False
    undeclared: dict = field(default_factory=dict)

    def watch(self, monkeypatch, kind):
        """Note what is read of the instances of a class of options."""
        leaves = {one.name for one in fields(kind)}
        plain = kind.__getattribute__

        def watched(options, name):
            value = plain(options, name)
            wanted = self.names is not None and name in leaves and not is_dataclass(value)
            if wanted and not (self.computing and copied(sys._getframe(1))):
                self.names.add(f"{kind.__name__}.{name}")
            return value

        monkeypatch.setattr(kind, "__getattribute__", watched)

    @contextmanager
    def noted(self, computing):
        before = self.names, self.computing
        self.names, self.computing = set(), computing
        try:
            yield self.names
        finally:
            self.names, self.computing = before

    def declared(self, stage, context):
        """What is in the key of a stage, and in those of the stages before it."""
        with self.noted(computing=False) as names:
            read_whole(stage.options(context.options))
            stage.reads(context)
            before = [one for one in stage.after if one.wanted(context)]
        return names.union(*(self.declared(one, context) for one in before))


def copied(frame):
    """Whether options are read to be copied, or checked as they are made: not for a result."""
    while frame is not None:
        made = frame.f_code.co_name == "__post_init__"
        if made or frame.f_globals["__name__"] == "dataclasses":
            return True
        frame = frame.f_back
    return False


def read_whole(value):
    """Read all fields of the tables among values."""
    if is_dataclass(value):
        value = tuple(getattr(value, one.name) for one in fields(value))
    if isinstance(value, tuple):
        for part in value:
            read_whole(part)


def classes_of(options):
    yield type(options)
    for one in fields(options):
        if is_dataclass(value := getattr(options, one.name)):
            yield from classes_of(value)


@pytest.fixture
def reads(monkeypatch):
    """What is read while stages are computed, compared with their keys."""
    noted = Reads()
    for kind in set(classes_of(PipelineOptions())):
        noted.watch(monkeypatch, kind)
    usual = Stage.run

    def run(stage, context):
        declared = noted.declared(stage, context)

        @wraps(stage.compute)
        def compute(*arguments):
            with noted.noted(computing=True) as names:
                counts = stage.compute(*arguments)
            if unknown := names - declared:
                noted.undeclared[stage.name] = unknown
            return counts

        usual(replace(stage, compute=compute), context)

    monkeypatch.setattr(Stage, "run", run)
    return noted


@pytest.fixture(scope="module")
def flat_capture(made_once):
    """Folder of a relief from above. Read only."""

    def fill(folder):
        write_capture(parse_scene(FLAT), folder)

    return made_once("flat", fill)[0]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("surface", ["solid", "flat"])
def test_what_a_stage_reads_is_in_its_key(
    model, surface, reads, tiny_capture, flat_capture, tmp_path
):
    if (model, surface) == ("half vector", "flat"):
        pytest.skip("half-vector fields are of solid objects")
    capture = tiny_capture if surface == "solid" else flat_capture
    options = with_tables(with_tables(PipelineOptions(), QUICK), MODELS[model])
    held_out = HoldOut(views=1 if surface == "solid" else 0, lights=1)
    stages.run(
        open_capture(capture), tmp_path, options, hold_out=held_out, resources=Resources(1)
    )
    assert not reads.undeclared
