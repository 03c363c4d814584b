"""Laws of reflection, and the units and sources of light."""
