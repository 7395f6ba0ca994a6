"""Matrices in, matrices out: completion, online SVD, local PCA. Knows nothing of captures."""
