"""Visual hull, mesh cleaning, atlas, texel table, visibility."""
