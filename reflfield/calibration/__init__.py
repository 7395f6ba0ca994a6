"""Lights from what they photographed: spheres and grey cards."""
