"""Photographs projected into texture space, the out-of-core store, resampling."""
