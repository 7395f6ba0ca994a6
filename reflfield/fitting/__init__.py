"""Fit of the half-vector model to samples and to photographs, and of the surface to normals."""
