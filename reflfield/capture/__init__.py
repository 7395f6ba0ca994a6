"""Cameras, lights, photographs and silhouettes, and the readers that bring them in."""
