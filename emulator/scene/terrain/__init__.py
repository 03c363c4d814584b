"""Terrain under a low Sun: heights, horizons, blocks and light."""
