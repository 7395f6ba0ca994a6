"""Dome photographs to relightable objects: 6D reflectance fields.

See Müller, Sarlette and Klein, "Data-driven Local Coordinate Systems for
Image-Based Rendering", Eurographics 2006, for the method that this package
implements and extends. The stages stand in order in `reflfield.pipeline.stages`.
"""

__version__ = "0.1.0"
