"""Rays to pixels: cameras, point lights, environment maps, turntables."""
