"""All effects, in the order in which they act."""

from __future__ import annotations

from dataclasses import replace

from capture_sim.effects import (
    Effect,
    antialiasing,
    bayer,
    black_level,
    defocus,
    environment,
    exposure_brackets,
    interreflection,
    light_extent,
    near_lights,
    quantisation,
    saturation,
    sensor_noise,
    shadows,
    simulated,
    subsurface,
    vignetting,
)
from capture_sim.effects.rig import RIG_EFFECTS
from capture_sim.errors import scene_error
from capture_sim.model import EffectOptions, Scene
from capture_sim.tables import Table, TableReader, read_options

EFFECTS: tuple[Effect, ...] = (
    *RIG_EFFECTS,
    antialiasing,
    near_lights,
    shadows,
    light_extent,
    environment,
    interreflection,
    subsurface,
    vignetting,
    defocus,
    bayer,
    sensor_noise,
    saturation,
    black_level,
    quantisation,
    exposure_brackets,
)

NAMES = tuple(effect.NAME for effect in EFFECTS)
_FORCED = {"on": True, "off": False}


def decided(scene: Scene) -> Scene:
    """The scene with the choice of its effects made once and for all.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    Scene
        With ``effects.active`` set, and default parameters of effects that are on
        though the scene has no table of theirs.
    """
    active = [effect for effect in EFFECTS if simulated(scene, effect)]
    bare = [e for e in active if scene.effects.declared(e.Options) is None]
    choice = replace(
        scene.effects,
        active=frozenset(effect.NAME for effect in active),
        parameters=(*scene.effects.parameters, *(effect.Options() for effect in bare)),
    )
    return replace(scene, effects=choice)


def read_effects(value: object) -> EffectOptions:
    """Choice and parameters of effects from the entry `effects` of a scene file.

    Parameters
    ----------
    value : str, list or mapping
        ``"auto"``, ``"all"``, ``"none"`` or a list of names; or a table with that as
        `simulate`, `tolerance`, and for each effect its parameters as a table, or
        ``"on"``, ``"off"`` or ``"auto"``.

    Returns
    -------
    EffectOptions

    Raises
    ------
    SceneError
        For unknown effects and keys and values out of range.

    Examples
    --------
    >>> read_effects(["shadows"]).simulate
    ('shadows',)
    >>> read_effects({"shadows": "off"}).forced
    {'shadows': False}
    """
    if isinstance(value, str | list):
        return EffectOptions(simulate=read_choice("effects", value))
    reader = TableReader("effects", value)  # type: ignore[arg-type]  # refuses what is no table
    simulate = read_choice("effects.simulate", reader.take("simulate", "auto"))
    tolerance = reader.number("tolerance", 1e-3, low=0.0, high=1.0)
    tables = {effect.NAME: reader.take(effect.NAME) for effect in EFFECTS}
    reader.finish()
    words = {name: value for name, value in tables.items() if isinstance(value, str)}
    return EffectOptions(
        simulate=simulate,
        tolerance=tolerance,
        forced={n: _FORCED[w] for n, w in words.items() if _word(n, w) in _FORCED},
        parameters=tuple(
            _parameters(effect, tables[effect.NAME])
            for effect in EFFECTS
            if tables[effect.NAME] is not None and effect.NAME not in words
        ),
    )


def read_choice(what: str, value: object) -> str | tuple[str, ...]:
    """``auto``, ``all``, ``none`` or a list of names of effects.

    Parameters
    ----------
    what : str
        Name used in messages.
    value : object
        As the scene file or the command line has it.

    Returns
    -------
    str or tuple of str

    Raises
    ------
    SceneError
        If it is neither.

    Examples
    --------
    >>> read_choice("effects", ["shadows", "near_lights"])
    ('shadows', 'near_lights')
    """
    if isinstance(value, str) and value in ("auto", "all", "none"):
        return value
    if not isinstance(value, list):
        raise scene_error(what, "auto, all, none or a list of names", value)
    unknown = [name for name in value if name not in NAMES]
    if unknown:
        raise scene_error(what, "names among " + ", ".join(NAMES), unknown)
    return tuple(value)


def _word(name: str, value: str) -> str:
    if value not in ("on", "off", "auto"):
        raise scene_error(f"effects.{name}", "a table, or one of auto, on, off", value)
    return value


def _parameters(effect: Effect, table: Table) -> object:
    return read_options(effect.Options, TableReader(f"effects.{effect.NAME}", table))
