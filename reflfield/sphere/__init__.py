"""Functions and rotations of the sphere: harmonics, Wigner-d, couplings, hemisphere grids."""
