"""Three groups of photographs: no choice sees what is reported."""

from dataclasses import replace

import numpy as np
import pytest

from reflfield.errors import InputError
from reflfield.options import HoldOut
from reflfield.pipeline.hold_out import split_of
from reflfield.tradeoff.photograph_groups import photograph_groups, spread, usual_hold_out


def names(photographs, is_test=None):
    return {p.name for p in photographs if is_test is None or p.is_test == is_test}


@pytest.mark.parametrize(
    "hold_out", [None, HoldOut(views=2, lights=1), HoldOut(photographs=7), HoldOut(lights=2)]
)
def test_no_photograph_is_in_two_groups(product, hold_out):
    groups = photograph_groups(product, hold_out)
    trained = names(groups.trained.photographs, is_test=False)
    chosen = names(groups.trained.photographs, is_test=True)
    reported = names(groups.reported.photographs)
    assert trained
    assert chosen
    assert reported
    assert not trained & chosen
    assert not (trained | chosen) & reported


def test_views_and_lights_that_are_held_out_are_held_out_everywhere(product):
    groups = photograph_groups(product, HoldOut(views=1, lights=1))
    of_field = [p.name for p in groups.trained.photographs if not p.is_test]
    ids = {c.id for c in groups.reported.cameras} | {
        light.id for light in groups.reported.lights
    }
    used = {groups.trained.cameras[v].id for v in groups.training_views}
    used |= {groups.trained.lights[i].id for i in groups.training_lights}
    assert not ids & used
    assert len(of_field) == 8 * 8


def test_the_split_of_a_run_is_that_of_the_groups(product):
    groups = photograph_groups(product)
    split = split_of(groups.trained, HoldOut(test=True))
    compared = {groups.trained.photographs[i].name for i in split.compared}
    assert compared == names(groups.trained.photographs, is_test=True)
    assert len(split.aside) == 0


@pytest.mark.parametrize(("views", "lights"), [(0.5, 1.0), (1.0, 0.25), (0.5, 0.5)])
def test_fewer_views_and_lights_are_measured_on_the_same_photographs(product, views, lights):
    groups = photograph_groups(product, HoldOut(views=1, lights=1))
    fewer = groups.with_fewer(views, lights)
    assert names(fewer.photographs, is_test=True) == names(groups.trained.photographs, True)
    trained = [p for p in fewer.photographs if not p.is_test]
    assert len({p.camera for p in trained}) == round(views * 8)
    assert len({p.light for p in trained}) == round(lights * 8)


def test_all_of_them_are_the_whole(product):
    groups = photograph_groups(product)
    assert names(groups.with_fewer().photographs) == names(groups.trained.photographs)
    assert spread(np.arange(5), 1.0) == set(range(5))


def test_what_is_usual_follows_from_the_counts(product):
    assert usual_hold_out(product) == HoldOut(views=2, lights=2)
    one_light = replace(
        product, photographs=tuple(p for p in product.photographs if p.light == 0)
    )
    assert usual_hold_out(one_light) == HoldOut(views=1)
    one_view = replace(
        product, photographs=tuple(p for p in product.photographs if not p.camera)
    )
    assert usual_hold_out(one_view) == HoldOut(lights=1)


def test_too_few_photographs_are_refused(product):
    few = replace(product, photographs=product.photographs[:3])
    with pytest.raises(InputError, match="expected at least 4 photographs"):
        photograph_groups(few)
