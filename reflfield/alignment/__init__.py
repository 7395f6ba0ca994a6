"""One local frame per texel, found from the data by correlation over SO(3)."""
