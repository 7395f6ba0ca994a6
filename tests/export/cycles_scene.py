"""Draw an exported folder in Blender, by its Python, which is not that of the tests.

    PYTHON cycles_scene.py FOLDER JOBS.json

JOBS holds ``world_from_camera`` (4 x 4, of Blender's axes: x right, y up, z backwards),
``fov``, ``size``, ``samples`` and ``images``: for each the file, the direction ``towards`` the
sun and whether it casts ``shadows``. No light but the sun's, and none from part to part.
"""

import importlib.util
import json
import sys
from pathlib import Path


def placed_camera(bpy, jobs):
    """Put the camera into the scene."""
    import mathutils

    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit = "HORIZONTAL"
    camera.angle = jobs["fov"]
    placed = bpy.data.objects.new("camera", camera)
    placed.matrix_world = mathutils.Matrix(jobs["world_from_camera"])
    return placed


def sun(bpy, image):
    """Lamp that gives 1 W/m^2 to a surface that faces it."""
    import mathutils

    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy, lamp.angle = 1.0, 0.0
    lamp.use_shadow = image["shadows"]
    placed = bpy.data.objects.new("sun", lamp)
    towards = mathutils.Vector(image["towards"])
    placed.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
    return placed


def prepare(scene, jobs):
    """Direct light only, pixels that are squares, linear values."""
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = jobs["samples"]
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    scene.cycles.max_bounces = 0
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.sample_clamp_direct = 0.0
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = jobs["size"]
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Raw"
    scene.world = None
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode = "OPEN_EXR", "RGBA"
    settings.color_depth = "32"


def main(folder, jobs):
    """Write the images of all jobs."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_enable(module="cycles")
    spec = importlib.util.spec_from_file_location("build_object", folder / "build_object.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.build()
    scene = bpy.context.scene
    prepare(scene, jobs)
    scene.camera = placed_camera(bpy, jobs)
    scene.collection.objects.link(scene.camera)
    for image in jobs["images"]:
        lamp = sun(bpy, image)
        scene.collection.objects.link(lamp)
        scene.render.filepath = image["file"]
        bpy.ops.render.render(write_still=True)
        bpy.data.objects.remove(lamp)
    print(bpy.app.version_string)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), json.loads(Path(sys.argv[2]).read_text()))
